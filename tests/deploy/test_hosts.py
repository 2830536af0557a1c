"""Files for other hosts: written from the graph, accepted by the tools they are for, each process with its own keys."""

from __future__ import annotations

import re
import shlex
import shutil
import string
import subprocess
import sys
from collections.abc import Iterator
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import pytest
import yaml
from support.commands import save_empty_field

from fieldpose.deploy.cli import main, parse
from fieldpose.deploy.commands import deploy, stage
from fieldpose.deploy.commands.deploy import Options
from fieldpose.deploy.graph import BY_NAME, CAMERA, HUB, RECORDER
from fieldpose.deploy.hosts.services import Site
from fieldpose.deploy.processes.preload import pipelines_of
from fieldpose.deploy.settings import read_settings

ROOT = Path(__file__).resolve().parents[2]
EXAMPLE = [
    "recordings/demo/field.safetensors", "--source", "camera:0", "--record.snapshots", "/var/lib/fieldpose/snapshots",
]  # fmt: skip
KINDS = ("compose", "kubernetes", "systemd")
needs = {
    tool: pytest.mark.skipif(shutil.which(tool) is None, reason=f"{tool} is not here")
    for tool in ("kubectl", "systemd-analyze", "docker")
}


def written(kind: str, folder: Path, *arguments: str) -> dict[str, str]:
    assert main(["deploy", kind, str(folder), *arguments]) == 0
    return {str(path.relative_to(folder)): path.read_text() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def rig(tmp_path: Path) -> list[str]:
    """The arguments of two objects in two cameras, of which matching and rendering are two processes each."""
    fields = [f"{name}={save_empty_field(tmp_path / f'{name}.safetensors')}" for name in ("lamp", "can")]
    (tmp_path / "left.json").write_text(
        '{"width": 64, "height": 48, "fx": 60, "fy": 60, "cx": 31.5, "cy": 23.5, "distortion": [0, 0, 0, 0, 0]}'
    )
    config = tmp_path / "rig.toml"
    config.write_text(
        f'[cameras.left]\nsource = "video:/films/left.mp4"\ncamera_file = "{tmp_path}/left.json"\n'
        '[cameras.right]\nsource = "camera:2"\n'
    )
    return [*fields, "--config", str(config), "--shares", "rendering=2", "matching=3", "--cores", "8"]


@pytest.mark.parametrize("kind", KINDS)
def test_the_examples_are_what_the_command_writes(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    assert {
        str(path.relative_to(ROOT / "deploy" / kind)): path.read_text()
        for path in (ROOT / "deploy" / kind).rglob("*") if path.is_file()
    } == written(kind, tmp_path / "made", *EXAMPLE)  # fmt: skip


def services_of(kind: str, files: dict[str, str]) -> dict[str, tuple[list[str], set[str]]]:
    """By the name of each service what `fieldpose` is given there, and which certificates it is."""
    if kind == "compose":
        made = yaml.safe_load(files["compose.yaml"])["services"]
        return {name: (one["command"], {s["source"] for s in one["secrets"]}) for name, one in made.items()}
    if kind == "systemd":
        return {name.removeprefix("fieldpose-").removesuffix(".service"): of_unit(text)
                for name, text in files.items() if name.endswith(".service")}  # fmt: skip
    documents = {(one["kind"], one["metadata"]["name"]): one for one in yaml.safe_load_all(files["fieldpose.yaml"])}
    secrets = {one["name"]: {name.removeprefix("certs/") for name in one["files"]}
               for one in yaml.safe_load(files["kustomization.yaml"])["secretGenerator"]}  # fmt: skip
    found = {}
    for (kind_of, name), one in documents.items():
        if kind_of in ("Deployment", "Job"):
            pod = one["spec"]["template"]["spec"]
            given = [v["secret"]["secretName"] for v in pod["volumes"] if "secret" in v]
            found[name] = (pod["containers"][0]["args"], set().union(*(secrets[secret] for secret in given)))
    return found


def of_unit(text: str) -> tuple[list[str], set[str]]:
    words = text.partition("ExecStart=")[2].partition("\nRestart=")[0].replace("\\\n", " ").split()
    keys = {line.partition("=")[2].partition(":")[0] for line in text.splitlines() if "LoadCredential" in line}
    return words[1:], keys


@pytest.mark.parametrize("kind", KINDS)
def test_each_process_of_the_graph_has_its_command_and_its_own_roles_certificate_alone(
    kind: str, rig: list[str], tmp_path: Path
) -> None:
    made = services_of(kind, written(kind, tmp_path / "site", *rig, "--record", "/var/lib/fieldpose/run.mcap"))
    pairs = [f"{object}-{camera}" for object in ("lamp", "can") for camera in ("left", "right")]
    shared = set(BY_NAME) - {"camera", "tracking", "perturbation", "retrieval", "rendering", "matching"}
    shares = {"rendering-1", "rendering-2", "matching-1", "matching-2", "matching-3"}
    assert set(made) == {*shared, *shares, "camera-left", "camera-right", *(f"tracking-{pair}" for pair in pairs)}
    for name, (words, keys) in made.items():
        assert words[0] == "stage"
        assert words[1] == name.partition("-")[0]
        assert keys == {"ca.pem", f"{words[1]}.pem", f"{words[1]}.key"}
        here = [word.replace("/etc/fieldpose", str(tmp_path / "site" / "config")) for word in words[1:]]
        assert parse(stage.Options, "stage", here).entry.tls is not None
    assert "2/3" in made["matching-2"][0]
    assert made["hub"][0][2:4] == ["--listen", "tls/0.0.0.0:7447"]
    assert "/var/lib/fieldpose/run-{start}.mcap" in made[RECORDER][0]
    assert "--no-shared-memory" in made["pnp"][0] or kind == "systemd"


def test_settings_are_as_the_processes_read_them_and_leave_open_what_each_host_has(
    rig: list[str], tmp_path: Path
) -> None:
    files = written("compose", tmp_path / "site", *rig)
    config = tmp_path / "site" / "config"
    listed = pipelines_of(config / "pipelines.json")
    assert [Path(str(one.field)) for one in listed] == [
        Path(f"/srv/fieldpose/fields/{name}.safetensors") for name in ("lamp", "can", "lamp", "can")
    ]
    settings = [read_settings(one.settings) for one in listed]
    assert [one.address.pair for one in settings] == ["lamp/left", "can/left", "lamp/right", "can/right"]
    assert {one.camera.objects for one in settings} == {("lamp", "can")}
    assert {(one.backend, one.matching.device) for one in settings} == {("auto", "auto")}
    assert settings[0].camera.camera_file == Path("/etc/fieldpose/left.json")
    assert (config / "left.json").read_bytes() == (tmp_path / "left.json").read_bytes()
    made = yaml.safe_load(files["compose.yaml"])["services"]
    assert {name for name, one in made.items() if "devices" in one} == {"camera-right"}
    assert made["camera-right"]["devices"] == ["/dev/video2:/dev/video2"]
    (film,) = [mount for mount in made["camera-left"]["volumes"] if "films" in mount["source"]]
    assert film["read_only"]
    fields = {name for name, one in made.items() if "/srv/fieldpose/fields" in str(one.get("volumes"))}
    assert {name.partition("-")[0] for name in fields} == {
        row.name for row in BY_NAME.values() if row.needs_field or row.name == CAMERA
    } - {"retrieval"}
    assert made["rendering-1"]["environment"]["NUMBA_NUM_THREADS"] == "8"
    assert made["pnp"]["environment"]["OMP_NUM_THREADS"] == "1"
    assert HUB in made


def test_containers_that_share_memory_have_one_dev_shm(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    field = str(save_empty_field(tmp_path / "field.safetensors"))
    arguments = [field, "--source", "bus", "--shared-memory"]
    made = yaml.safe_load(written("compose", tmp_path / "site", *arguments)["compose.yaml"])["services"]
    assert all(
        one["ipc"] == "host" and one["ulimits"]["memlock"] == -1 and "--no-shared-memory" not in one["command"]
        for one in made.values()
    )
    assert CAMERA not in made
    assert main(["deploy", "kubernetes", str(tmp_path / "pods"), *arguments]) == 2
    assert "pods do not share /dev/shm" in capsys.readouterr().err
    assert not (tmp_path / "pods").exists()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--shares", "rendering"], "--shares 'rendering': expected STAGE=NUMBER"),
        (["--shares", "rendering=2"], "shares: rendering=2: there are 1 pipelines to share"),
        (["--shares", "tracking=1"], "shares: tracking cannot be several; expected one of retrieval, rendering"),
        (["--source", "video:film.mp4"], "give the whole path that it has on the camera's host"),
        (["--join", "robot"], "'robot' is no address of a hub"),
        (["--cores", "0"], "--cores 0: expected 1 to 1024"),
        (["--record", "/data/run.mcap"], "--record /data/run.mcap: services write below /var/lib/fieldpose alone"),
        (["--record", "../run.mcap"], "--record ../run.mcap: services write below /var/lib/fieldpose alone"),
        (["--record.snapshots", "/tmp"], "--record.snapshots /tmp: services write below /var/lib/fieldpose alone"),
        (["--executable", "/opt/fieldpose"], "--executable is of systemd alone, and compose was asked for"),
        (["--namespace", "cell-2"], "--namespace is of kubernetes alone, and compose was asked for"),
    ],
)
def test_mistakes_are_one_line_and_leave_nothing(
    arguments: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    field = str(save_empty_field(tmp_path / "field.safetensors"))
    source = [] if "--source" in arguments else ["--source", "camera:0"]
    assert main(["deploy", "compose", str(tmp_path / "site"), field, *source, *arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line
    assert not (tmp_path / "site").exists()


@pytest.mark.parametrize(
    ("kind", "arguments", "said"),
    [
        ("systemd", ["--executable", "fieldpose"], "--executable fieldpose: expected the whole path"),
        (
            "kubernetes",
            ["--namespace", "My_robots"],
            "--namespace My_robots: expected small letters, digits and hyphens",
        ),
    ],
)
def test_what_is_of_one_kind_alone_is_checked(
    kind: str, arguments: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    field = str(save_empty_field(tmp_path / "field.safetensors"))
    assert main(["deploy", kind, str(tmp_path / "site"), field, "--source", "camera:0", *arguments]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "site").exists()


def test_what_was_changed_by_hand_is_not_overwritten_unless_asked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    field = str(save_empty_field(tmp_path / "field.safetensors"))
    before = written("systemd", tmp_path / "site", field, "--source", "camera:0")
    unit = tmp_path / "site" / "fieldpose-pnp.service"
    unit.write_text("mine")
    assert main(["deploy", "systemd", str(tmp_path / "site"), field, "--source", "camera:0"]) == 2
    assert f"{unit}: is there already, and differs; give --again" in capsys.readouterr().err
    assert unit.read_text() == "mine"
    assert written("systemd", tmp_path / "site", field, "--source", "camera:0", "--again") == before


def test_units_that_are_no_more_go_with_again_and_others_stay(
    rig: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    site = tmp_path / "site"
    written("systemd", site, *rig, "--shares", "pnp=2")
    mine = site / "fieldpose-mine.service"
    mine.write_text("[Unit]\n")
    assert main(["deploy", "systemd", str(site), *rig]) == 2
    assert "give --again to remove it" in capsys.readouterr().err
    written("systemd", site, *rig, "--again")
    assert not list(site.glob("fieldpose-pnp-*.service"))
    assert (site / "fieldpose-pnp.service").exists()
    assert mine.exists()


@pytest.mark.parametrize("kind", KINDS)
def test_a_recorder_writes_where_it_may_and_has_the_memory_for_its_ring(kind: str, tmp_path: Path) -> None:
    field = str(save_empty_field(tmp_path / "f.safetensors"))
    kept = ["--record", "run.mcap", "--record.snapshots", "lost", "--record.ring-size", "3GB"]
    files = written(kind, tmp_path / "site", field, "--source", "bus", *kept)
    words, _ = services_of(kind, files)["recorder"]
    assert "/var/lib/fieldpose/run-{start}.mcap" in words
    assert "/var/lib/fieldpose/lost" in words
    limits = re.findall(r"(?:memory: |MemoryMax=)(\d+)M", "\n".join(files.values()))
    assert set(limits) >= {"2048", "8048"}


def test_a_camera_of_files_is_a_job_and_another_groups_hub_is_let_in(
    rig: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = written("kubernetes", tmp_path / "site", *rig, "--namespace", "cell-2")
    assert "to be deleted before it is applied again: camera-left\n" in capsys.readouterr().out
    made = list(yaml.safe_load_all(files["fieldpose.yaml"]))
    kinds = {one["metadata"]["name"]: one["kind"] for one in made if one["kind"] in ("Deployment", "Job")}
    assert [name for name, kind in kinds.items() if kind == "Job"] == ["camera-left"]
    (film,) = (one["spec"] for one in made if one["kind"] == "Job")
    assert film["template"]["spec"]["restartPolicy"] == "OnFailure"
    assert [one["metadata"]["name"] for one in made if one["kind"] == "Namespace"] == ["cell-2"]
    assert yaml.safe_load(files["kustomization.yaml"])["namespace"] == "cell-2"
    (hubs,) = (one["spec"] for one in made if one["metadata"]["name"] == "fieldpose-hubs")
    (ingress,) = hubs["ingress"]
    assert ingress["from"][0]["namespaceSelector"] == {}
    assert ingress["from"][0]["podSelector"] == hubs["podSelector"]


def test_files_beyond_what_a_config_map_holds_are_refused(
    rig: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    camera = tmp_path / "left.json"
    camera.write_text(camera.read_text() + " " * 999_000)
    assert main(["deploy", "kubernetes", str(tmp_path / "site"), *rig]) == 2
    assert "the files that settings name have 1" in capsys.readouterr().err
    assert not (tmp_path / "site").exists()


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_printed_names_all_that_was_written(
    kind: str, rig: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    site = tmp_path / "site"
    files = written(kind, site, *rig)
    said = capsys.readouterr().out
    named = {name for name in files if any(fnmatch(name, word.strip(",:;")) for word in said.split())}
    if kind == "kubernetes":
        assert f"kubectl apply -k {site};" in said
        kustomization = yaml.safe_load(files["kustomization.yaml"])
        named = {"kustomization.yaml", *kustomization["resources"], *kustomization["configMapGenerator"][0]["files"]}
        assert main(["certs", str(site / "certs"), "--hosts", "hub"]) == 0
        assert all((site / name).is_file() for one in kustomization["secretGenerator"] for name in one["files"])
    elif kind == "compose":
        named |= {name for name in files if name.startswith("config/")}
        up = said.partition("--remove-orphans ")[2].split("\n")[0].split()
        assert up == list(yaml.safe_load(files["compose.yaml"])["services"])
    assert named == set(files)
    assert all(f"{tmp_path}/{name}.safetensors" in said for name in ("lamp", "can"))


@pytest.mark.parametrize("kind", KINDS)
def test_odd_names_come_through(kind: str, rig: list[str], tmp_path: Path) -> None:
    film, record = """/films/it's 50% of $HOME $(A) "a" \\ ;#b.mp4""", "/var/lib/fieldpose/$(X) 1%.mcap"
    field = save_empty_field(tmp_path / "$a 'b'.safetensors")
    executable = "/opt/$x 1%/fieldpose"
    odd = [str(field), "--source", f"video:{film}", "--record", record]
    odd += ["--executable", executable] if kind == "systemd" else []
    files = written(kind, tmp_path / "site", *odd)
    named = {"/srv/fieldpose/fields/$a 'b'.safetensors", "/var/lib/fieldpose/$(X) 1%-{start}.mcap"}
    if kind == "systemd":
        unit = files["fieldpose-recorder.service"].partition("ExecStart=")[2].partition("\nRestart=")[0]
        program, *given = shlex.split(unit.replace("\\\n", " "))
        assert program.replace("%%", "%") == executable
        words = [word.replace("%%", "%").replace("$$", "$") for word in given]
        (bound,) = re.findall("BindReadOnlyPaths=(.*)", files["fieldpose-camera.service"])
        (reads,) = (word.replace("%%", "%") for word in shlex.split(bound))
    elif kind == "compose":
        made = yaml.safe_load(files["compose.yaml"])["services"]
        words = [string.Template(word).safe_substitute() for word in made["recorder"]["command"]]
        reads = string.Template(made["camera"]["volumes"][-1]["source"]).substitute()
    else:
        made = {one["metadata"]["name"]: one for one in yaml.safe_load_all(files["fieldpose.yaml"])
                if one["kind"] in ("Deployment", "Job")}  # fmt: skip
        args = made["recorder"]["spec"]["template"]["spec"]["containers"][0]["args"]
        # As Kubernetes does, for which $(X) is a variable.
        words = [re.sub(r"(?<!\$)\$\((\w+)\)", "unknown", word).replace("$$", "$") for word in args]
        volumes = made["camera"]["spec"]["template"]["spec"]["volumes"]
        (reads,) = (v["hostPath"]["path"] for v in volumes if "hostPath" in v)
    assert named <= set(words)
    assert reads == film


@pytest.mark.parametrize("kind", ["compose", "kubernetes"])
def test_a_device_that_containers_cannot_be_given_is_refused(
    kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    field, device = str(save_empty_field(tmp_path / "f.safetensors")), "/dev/v4l/by-path/pci-0000:00:14.0-usb"
    assert main(["deploy", kind, str(tmp_path / "site"), field, "--source", f"camera:{device}"]) == 2
    assert f"{device}: containers take no device with a colon" in capsys.readouterr().err
    assert not (tmp_path / "site").exists()
    files = written("systemd", tmp_path / "site", field, "--source", f"camera:{device}")
    assert f'DeviceAllow="{device}" rw' in files["fieldpose-camera.service"]


@pytest.mark.parametrize("kind", KINDS)
def test_a_name_cannot_begin_a_line_of_its_own(kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    field = str(save_empty_field(tmp_path / "f.safetensors"))
    assert main(["deploy", kind, str(tmp_path / "site"), field, "--source", "video:/a\nUser=root\n.mp4"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "has a control character" in line
    assert not (tmp_path / "site").exists()


def test_compose_reads_its_file(rig: list[str], tmp_path: Path) -> None:
    compose_spec = pytest.importorskip("compose_spec")
    text = written("compose", tmp_path / "site", *rig)["compose.yaml"]
    # As Compose does it before it reads what a value must look like.
    text = re.sub(r"\$\{\w+:-([^}]*)\}", r"\1", text)
    read = compose_spec.PyCompose.from_yaml(text)
    assert set(read.services) == set(yaml.safe_load(text)["services"])
    with pytest.raises(ValueError, match="read_only"):
        compose_spec.PyCompose.from_yaml(text.replace("read_only: true", "read_only: [1]"))


@needs["docker"]
def test_docker_compose_accepts_its_file(rig: list[str], tmp_path: Path) -> None:
    if subprocess.run(["docker", "compose", "version"], capture_output=True).returncode != 0:
        pytest.skip("docker has no plugin compose")
    written("compose", tmp_path / "site", *rig)
    subprocess.run(["docker", "compose", "config", "-q"], cwd=tmp_path / "site", check=True)


def manifests(rig: list[str], folder: Path) -> Iterator[dict[str, Any]]:
    written("kubernetes", folder, *rig)
    assert main(["certs", str(folder / "certs"), "--hosts", "hub"]) == 0
    built = subprocess.run(["kubectl", "kustomize", str(folder)], capture_output=True, text=True, check=True)
    yield from yaml.safe_load_all(built.stdout)


@needs["kubectl"]
def test_kubernetes_manifests_are_of_their_schemas_and_find_their_secrets(rig: list[str], tmp_path: Path) -> None:
    validator = pytest.importorskip("kubernetes_validate")
    made = list(manifests([*rig, "--record.snapshots", "/var/lib/fieldpose/lost"], tmp_path / "site"))
    for one in made:
        validator.validate(one, "1.32", strict=True)
    there = {(one["kind"], one["metadata"]["name"]) for one in made}
    pods = [one["spec"]["template"]["spec"] for one in made if one["kind"] in ("Deployment", "Job")]
    assert len(pods) == 16
    for pod in pods:
        (container,) = pod["containers"]
        assert {mount["name"] for mount in container["volumeMounts"]} == {volume["name"] for volume in pod["volumes"]}
        assert pod["securityContext"]["runAsNonRoot"]
        assert container["securityContext"]["readOnlyRootFilesystem"]
        for volume in pod["volumes"]:
            if "secret" in volume:
                assert ("Secret", volume["secret"]["secretName"]) in there
            if "configMap" in volume:
                assert ("ConfigMap", volume["configMap"]["name"]) in there
            if "persistentVolumeClaim" in volume:
                assert ("PersistentVolumeClaim", volume["persistentVolumeClaim"]["claimName"]) in there


@needs["systemd-analyze"]
def test_systemd_accepts_its_units(rig: list[str], tmp_path: Path) -> None:
    program = Path(sys.executable).with_name("fieldpose")
    written("systemd", tmp_path / "site", *rig, "--executable", str(program), "--record", "/var/lib/fieldpose/a.mcap")
    units = sorted(str(path) for path in (tmp_path / "site").glob("fieldpose*.*") if path.suffix != ".conf")
    done = subprocess.run(["systemd-analyze", "verify", *units], capture_output=True, text=True)
    assert (done.returncode, [line for line in done.stderr.splitlines() if "fieldpose" in line]) == (0, [])


def test_a_site_is_all_that_is_needed_to_write_it_again(rig: list[str], tmp_path: Path) -> None:
    options = parse(Options, "deploy", ["compose", str(tmp_path), *rig])
    site = options.site()
    assert isinstance(site, Site)
    words = site.made_by.split()
    again = parse(deploy.Options, "deploy", ["compose", str(tmp_path), *words[4:]])
    assert again.site() == site
