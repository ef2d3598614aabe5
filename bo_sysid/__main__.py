"""``python -m bo_sysid`` is ``bo-sysid``."""

import sys

from bo_sysid.cli import main

sys.exit(main())
