"""Show robots of your own in the browser.

    python examples/10_viewer.py [SECONDS]

Writes three robots to a folder and opens the viewer at their gallery. Prints the address, and
serves until you press Ctrl-C, or for a number of seconds.
"""

import sys
import time
from contextlib import suppress

import morphgen
from morphgen.viewer.app.app import serve


def main() -> None:
    """Write the robots and serve."""
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else float("inf")
    for words in ("planar-cube", "arm3-stick", "chain beads=4"):
        morphgen.write(morphgen.compose(words), "robots", picture=False)
    viewer = serve(["robots"])  # also: a robot, a split, words of compose, a policy's checkpoint
    print(f"http://127.0.0.1:{viewer.port}  (stop with Ctrl-C)", flush=True)
    end = time.monotonic() + seconds
    with suppress(KeyboardInterrupt):
        while time.monotonic() < end:
            time.sleep(0.1)
    viewer.stop()


if __name__ == "__main__":  # the viewer's workers are processes of their own
    main()
