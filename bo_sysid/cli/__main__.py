"""``python -m bo_sysid.cli``: the command line where its script is not on the path."""

import sys

from bo_sysid.cli import main

sys.exit(main())
