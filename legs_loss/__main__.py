"""``python -m legs_loss`` is ``legs``."""

from __future__ import annotations

import sys

from legs_loss.cli import main

if __name__ == "__main__":
    sys.exit(main())
