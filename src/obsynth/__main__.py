"""``python -m obsynth`` is ``obsynth``."""

import sys

from obsynth.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
