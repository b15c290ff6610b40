"""``python -m morphgen``."""

import sys

from morphgen.cli import main

sys.exit(main())
