"""`python -m fieldpose` is `fieldpose`."""

import sys

from fieldpose.deploy.cli import main

sys.exit(main())
