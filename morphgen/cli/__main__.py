"""``python -m morphgen.cli``."""

import sys

from morphgen.cli import main

sys.exit(main())
