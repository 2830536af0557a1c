"""Certificates for several hosts: what is made, who may read it, what is said, and what is never overwritten."""

from __future__ import annotations

import stat
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.x509.oid import NameOID
from support.commands import save_empty_field

from fieldpose.deploy.access.roles import roles
from fieldpose.deploy.cli import main


def test_each_role_has_a_certificate_of_one_authority_for_the_hosts_and_days_asked_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "new" / "certs"
    assert main(["certs", str(folder), "--hosts", "robot", "10.0.0.2", "--days", "30"]) == 0
    authority = x509.load_pem_x509_certificate((folder / "ca.pem").read_bytes())
    names = {role.name for role in roles()}
    assert {path.stem for path in folder.iterdir()} == {"ca", *names}
    assert not (folder / "ca.key").exists()
    for name in names:
        certificate = x509.load_pem_x509_certificate((folder / f"{name}.pem").read_bytes())
        certificate.verify_directly_issued_by(authority)
        assert [part.value for part in certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)] == [name]
        hosts = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        assert {"robot", "localhost"} <= set(hosts.get_values_for_type(x509.DNSName))
        assert {"10.0.0.2", "127.0.0.1"} <= {str(a) for a in hosts.get_values_for_type(x509.IPAddress)}
        left = certificate.not_valid_after_utc - datetime.now(UTC)
        assert timedelta(days=29) < left < timedelta(days=31)
        assert stat.S_IMODE((folder / f"{name}.key").stat().st_mode) == 0o600
    said = capsys.readouterr().out
    assert all(f"  {name}.pem " in said for name in names)
    assert "PRIVATE" not in said


def test_nothing_is_overwritten_and_nothing_half_made_is_left(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "certs"
    assert main(["certs", str(folder), "--roles", "viewer"]) == 0
    before = {path: path.read_bytes() for path in folder.iterdir()}
    assert main(["certs", str(folder)]) == 2
    assert main(["certs", str(tmp_path / "other"), "--hosts", "two words"]) == 2
    assert {path: path.read_bytes() for path in folder.iterdir()} == before
    assert [path.name for path in tmp_path.iterdir()] == ["certs"]
    first, second = capsys.readouterr().err.splitlines()
    assert first == f"fieldpose: {folder}: is there already, and is not overwritten; choose another folder"
    assert second.startswith("fieldpose: 'two words' is no host")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [(["--days", "0"], "expected 1 to"), (["--roles", "boss"], "no role 'boss'; expected one of hub, recorder")],
)
def test_mistakes_are_one_line(
    arguments: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["certs", str(tmp_path / "certs"), *arguments]) == 2
    assert said in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("listen", ["tcp/0.0.0.0:0", "tls/0.0.0.0:0"])
def test_a_run_that_others_reach_and_nobody_is_kept_out_of_is_refused(
    listen: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("FIELDPOSE_TLS", raising=False)
    field = save_empty_field(tmp_path / "field.safetensors")
    assert main(["run", str(field), "--source", "bus", "--listen", listen]) == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.startswith(f"fieldpose: {listen} can be reached by other hosts, and everybody there could read")
    assert "--tls DIR" in said
    assert "--open" in said


def test_certificates_named_by_the_environment_are_used(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FIELDPOSE_TLS", str(tmp_path))
    assert main(["top", "--connect", "tcp/127.0.0.1:1", "--once"]) == 2
    assert f"{tmp_path}: no certificate and key of the role viewer; there are those of: none" in capsys.readouterr().err
