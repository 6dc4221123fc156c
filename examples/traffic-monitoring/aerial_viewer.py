"""AerialViewer, a passenger of the drone: takes a picture every 2 s."""

import pictures

if __name__ == "__main__":
    pictures.main(interval_s=2.0)
