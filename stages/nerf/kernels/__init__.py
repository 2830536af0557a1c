"""The hot loops of the field, compiled by numba; `stages.nerf.twin` is their plain counterpart.

Numba's cache notices changes of the file that a kernel stands in, not of those whose functions the kernel calls.
So each state of this folder's sources has a cache of its own.
"""

import hashlib
from pathlib import Path

import numba

_HERE = Path(__file__).parent
_SOURCES = b"".join(path.read_bytes() for path in sorted(_HERE.glob("*.py")))
_STATE = hashlib.sha256(_SOURCES).hexdigest()[:16]

numba.config.CACHE_DIR = str(Path(numba.config.CACHE_DIR or _HERE / "__pycache__") / f"kernels-{_STATE}")
