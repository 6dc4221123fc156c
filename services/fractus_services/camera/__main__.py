"""`python -m fractus_services.camera`: the camera service of a node."""

from fractus_services.commands import camera

if __name__ == "__main__":
    camera()
