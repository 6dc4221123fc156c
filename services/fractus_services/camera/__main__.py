"""Run the camera service of a node with `python -m fractus_services.camera`."""

from fractus_services.commands import camera

if __name__ == "__main__":
    camera()
