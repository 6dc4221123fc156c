"""GroundViewer, at the roadside: takes a picture every 5 s."""

import pictures

if __name__ == "__main__":
    pictures.main(interval_s=5.0)
