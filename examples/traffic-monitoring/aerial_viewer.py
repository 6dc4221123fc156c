"""AerialViewer, a passenger of the drone: a picture from above every 2 s."""

import pictures

if __name__ == "__main__":
    pictures.main(interval_s=2.0)
