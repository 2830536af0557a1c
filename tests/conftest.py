"""Tests import what they share as `support.…`, wherever pytest is started from, and always try the same examples."""

import sys
from pathlib import Path

from hypothesis import settings

sys.path.insert(0, str(Path(__file__).parent))
settings.register_profile("same_each_time", derandomize=True)
settings.load_profile("same_each_time")
