"""The supervisor of a pipeline's processes as a program: supervisord, except that it ends with its parent."""

from __future__ import annotations

import os
import sys

from supervisor.supervisord import main

from fieldpose.deploy.processes.lifeline import PARENT, die_with_parent

if __name__ == "__main__":
    die_with_parent()
    # For this process alone: its children have another parent.
    os.environ.pop(PARENT, None)
    main(sys.argv[1:])
