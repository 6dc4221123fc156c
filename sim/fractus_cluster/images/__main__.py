"""`python -m fractus_cluster.images`: build the container images."""

from fractus_cluster.images.cli import images

if __name__ == "__main__":
    images(prog_name="fractus images")
