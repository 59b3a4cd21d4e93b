"""``python -m lanebev`` is the command ``lanebev``."""

import sys

from lanebev.cli import main

sys.exit(main())
