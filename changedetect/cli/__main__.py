"""``python -m changedetect.cli``."""

from __future__ import annotations

import sys

from changedetect.cli import main

if __name__ == "__main__":
    sys.exit(main())
