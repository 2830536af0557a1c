"""The image: linted, small, of no superuser; built where there is a Docker daemon."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from fieldpose.deploy.hosts.services import CACHE, CONFIG, FIELDS, STATE

ROOT = Path(__file__).resolve().parents[2]
DOCKERFILE = (ROOT / "Dockerfile").read_text()
COMPILERS = ("gcc", "g++", "build-essential", "clang", "cmake")


def stages() -> list[str]:
    """The text of each stage, from its FROM on."""
    return re.split(r"(?m)^(?=FROM )", DOCKERFILE)[1:]


def test_its_last_stage_has_no_compiler_and_no_superuser() -> None:
    build, final = stages()
    images = {re.match(r"FROM (\S+)", stage)[1] for stage in (build, final)}  # type: ignore[index]
    (image,) = images
    assert re.fullmatch(r"python:3\.11\.\d+-slim-\w+", image)
    assert "AS build" in build
    assert not any(re.search(rf"(?<![\w-]){re.escape(name)}(?![\w-])", DOCKERFILE) for name in COMPILERS)
    assert "pip" not in final
    assert "USER 1000:1000" in final
    assert final.index("USER") > final.rindex("RUN")
    assert 'ENTRYPOINT ["fieldpose"]' in final


def test_it_is_pinned_as_everything_else_is() -> None:
    installs = [line for line in DOCKERFILE.replace("\\\n", " ").splitlines() if "pip install" in line]
    assert all("-c constraints.txt" in line.partition("pip install")[2] for line in installs)
    assert DOCKERFILE.count("pip install") == DOCKERFILE.count("-c constraints.txt")
    minor = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["requires-python"].removeprefix(">=")
    assert f"python:{minor}." in DOCKERFILE


def test_it_has_the_folders_that_services_are_given() -> None:
    final = stages()[-1]
    assert all(folder in final for folder in (STATE, CACHE, CONFIG, FIELDS))
    written = re.search(r"install -d -m 1777 (.*) \\", final)
    assert written is not None
    assert written[1].split() == [STATE, CACHE]


def test_what_it_copies_is_let_through_and_there() -> None:
    let_through = {line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    copied = [word for line in re.findall(r"(?m)^COPY (?!--from)(.*)$", DOCKERFILE) for word in line.split()[:-1]]
    assert set(copied) == let_through
    assert all((ROOT / name).exists() for name in copied)


def test_hadolint_finds_nothing() -> None:
    linter = shutil.which("hadolint") or str(Path(sys.executable).with_name("hadolint"))
    if not Path(linter).exists():
        pytest.skip("hadolint is not here")
    done = subprocess.run([linter, str(ROOT / "Dockerfile")], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "")


@pytest.mark.slow
def test_docker_builds_it_and_it_runs_as_no_superuser() -> None:
    docker = shutil.which("docker")
    if docker is None or subprocess.run([docker, "version"], capture_output=True).returncode != 0:
        pytest.skip("no Docker daemon is here")
    subprocess.run([docker, "build", "-q", "-t", "fieldpose:test", str(ROOT)], check=True, capture_output=True)
    read_only = [docker, "run", "--rm", "--read-only", "--tmpfs", "/tmp", "--cap-drop", "ALL"]
    done = subprocess.run([*read_only, "fieldpose:test", "--version"], check=True, capture_output=True, text=True)
    assert done.stdout.startswith("fieldpose ")
    user = [*read_only, "--entrypoint", "id", "fieldpose:test", "-u"]
    assert subprocess.run(user, check=True, capture_output=True, text=True).stdout == "1000\n"
