"""Tests import what they share as `support.…`, wherever pytest is started from, and always try the same examples.

In tests, calls of the modules below check the shapes and dtypes of the arrays that they get and give. Left out are
geometry's rigid, errors and limits, whose small functions are called so often that tests would take a fifth longer.
"""

import os
import sys
from pathlib import Path

from hypothesis import settings
from jaxtyping import install_import_hook

CHECKED = (
    "fieldpose.stages.alignment.images",
    "fieldpose.stages.alignment.landmarks",
    "fieldpose.stages.alignment.placing",
    "fieldpose.stages.alignment.views",
    "fieldpose.stages.geometry.cameras",
    "fieldpose.stages.geometry.jacobians",
    "fieldpose.stages.geometry.sampling",
    "fieldpose.stages.geometry.uncertainty",
    "fieldpose.stages.lifting.core",
    "fieldpose.stages.matching.core",
    "fieldpose.stages.nerf.rendering_api",
    "fieldpose.stages.pnp.aligner",
    "fieldpose.stages.pnp.consensus",
    "fieldpose.stages.pnp.core",
    "fieldpose.stages.refinement.core",
    "fieldpose.stages.refinement.photometric",
    "fieldpose.stages.rendering.core",
    "fieldpose.stages.retrieval.core",
    "fieldpose.stages.structure.adjustment",
    "fieldpose.stages.structure.colmap",
    "fieldpose.stages.structure.similarity",
    "fieldpose.stages.structure.tracks",
    "fieldpose.stages.structure.triangulation",
    "fieldpose.stages.tracking.policy",
)

sys.path.insert(0, str(Path(__file__).parent))
install_import_hook(CHECKED, 'importlib.import_module("support.shapes").checked')
settings.register_profile("same_each_time", derandomize=True, deadline=None)
settings.load_profile("same_each_time")

# Before torch is imported: on pictures so small, threads wait for each other longer than they work, and beside other
# work many times as long. Processes that fieldpose starts have budgets of their own.
for name, value in {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "OMP_WAIT_POLICY": "passive"}.items():
    os.environ.setdefault(name, value)
