"""Keys whose certificates a company's authority signs: requests, what is taken in, and whose certificate counts."""

from __future__ import annotations

import os
import shutil
import stat
from datetime import UTC, datetime, timedelta

import pytest
from company import Company
from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding

from runner.core.roles import Role
from runner.errors import UserError
from runner.security import keyring
from runner.security.identities import Identities, Presented
from runner.security.keyring import Keyring

ASKED = ("vehicle=car", "host=10.0.0.2", "controller=alice", "broker=10.0.0.1")


@pytest.fixture(scope="module")
def company(tmp_path_factory):
    return Company(tmp_path_factory.mktemp("company") / "acme")


@pytest.fixture
def keys(tmp_path, tod, company):
    """A directory with three requests."""
    output = tmp_path / "keys"
    assert tod("keys", f"output={output}", f"ca={company.ca}", *ASKED).status == 0
    return output


def signed(company, keys, name, **how):
    """A file as the company returns it."""
    file = keys.parent / f"{name}.pem"
    file.write_bytes(company.sign(keys / "requests" / f"{name}.csr", **how))
    return file


@pytest.fixture
def complete(tod, company, keys):
    files = [str(signed(company, keys, name)) for name in ("car", "alice", "broker")]
    done = tod("keys", f"output={keys}", f"signed={','.join(files)}")
    assert done.status == 0, done.err
    return keys


def test_requests_are_written_and_nothing_else_can_be_copied(tod, keys):
    asked = [keys / "requests" / f"{name}.csr" for name in ("alice", "broker", "car")]
    listed = tod("keys", f"output={keys}", *ASKED)
    assert listed.out == f"to be signed: {', '.join(map(str, asked))}; then give signed=FILE[,FILE...]\n"
    assert sorted(os.listdir(keys)) == ["authority", "requests"]
    assert not (keys / "authority" / "authority.key").exists()
    request = x509.load_pem_x509_csr(asked[2].read_bytes())
    assert [each.value for each in request.subject] == ["vehicle", "car"]
    hosts = request.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert [str(each.value) for each in hosts] == ["10.0.0.2"]


def test_signed_certificates_complete_the_directories(complete):
    common = {"ca.crt", "own.crt", "own.key", "own.secret", "own.json", "holders.json"}
    assert set(os.listdir(complete / "car")) == common | {"people.json", "srt.passphrase"}
    assert set(os.listdir(complete / "alice")) == common | {"media.secret", "page.token"}
    assert "crlfile" not in (complete / "broker" / "mosquitto.conf").read_text()
    assert os.listdir(complete / "requests") == []
    assert stat.S_IMODE((complete / "car" / "own.key").stat().st_mode) == 0o600
    ring = Keyring.of(complete / "car", keyring.PEOPLE)
    assert (ring.holder.name, ring.holder.company, ring.revoked()) == ("car", True, frozenset())
    assert len(x509.load_pem_x509_certificates(ring.certificate.read_bytes())) == 2  # with the intermediate
    assert ring.people()["alice"].role is Role.CONTROLLER


def presented(file):
    return Presented.of(x509.load_pem_x509_certificate(file.read_bytes()).public_bytes(Encoding.DER))


def test_only_keys_that_were_asked_for_count_whatever_the_company_signs(company, complete):
    known = Identities(Keyring.of(complete / "alice"), print)
    car = known.holder(presented(complete / "car" / "own.crt"))
    assert (car.name, car.role) == ("car", Role.VEHICLE)
    assert known.holder(presented(complete / "broker" / "own.crt")).role is Role.BROKER
    certificate, _ = company.issue("car", "10.0.0.2")
    assert known.holder(presented(certificate)) == "its certificate is of nobody whom these keys know"


def test_a_new_certificate_for_the_same_key_changes_nothing_else(tod, company, complete):
    before = {path: path.read_bytes() for path in complete.glob("*/*") if "authority" not in path.parts}
    shutil.copytree(complete / "alice", complete.parent / "copy")
    file = complete.parent / "renewed.pem"
    key = x509.load_pem_x509_certificate((complete / "alice" / "own.crt").read_bytes()).public_key()
    file.write_bytes(company.signed(key, []))
    assert tod("keys", f"output={complete}", f"signed={file}").status == 0
    changed = {path.relative_to(complete) for path, content in before.items() if path.read_bytes() != content}
    assert {str(path) for path in changed} == {"alice/own.crt"}


def test_rotated_keys_stay_in_force_until_their_certificate_is_there(tod, company, complete):
    old = presented(complete / "alice" / "own.crt")

    def known():
        return Identities(Keyring.of(complete / "car"), print).holder(old)

    assert tod("keys", f"output={complete}", "rotate=alice").status == 0
    assert known().name == "alice"
    assert tod("keys", f"output={complete}", f"signed={signed(company, complete, 'alice')}").status == 0
    assert known() == "its certificate is of nobody whom these keys know"


def test_a_revoked_holder_is_unknown_without_a_list_of_the_company(tod, complete):
    old = presented(complete / "alice" / "own.crt")
    assert tod("keys", f"output={complete}", "revoke=alice").status == 0
    known = Identities(Keyring.of(complete / "car"), print)
    assert known.holder(old) == "its certificate is of nobody whom these keys know"
    assert Keyring.of(complete / "car").people() == {}
    assert not (complete / "alice").exists()


def test_the_companys_list_counts_once_it_is_taken_in(tod, company, complete):
    alice = presented(complete / "alice" / "own.crt")
    assert tod("keys", f"output={complete}", f"crl={company.revocations(alice.serial)}").status == 0
    assert Identities(Keyring.of(complete / "car"), print).holder(alice) == "its certificate is revoked"
    assert "crlfile" in (complete / "broker" / "mosquitto.conf").read_text()


def test_all_problems_of_signed_certificates_are_named_together_and_nothing_is_taken(tod, company, keys, tmp_path):
    other, _ = company.issue("else")
    late = signed(company, keys, "alice", ends=timedelta(days=-35))
    bare = tmp_path / "bare.pem"
    request = x509.load_pem_x509_csr((keys / "requests" / "car.csr").read_bytes())
    leaf, _ = x509.load_pem_x509_certificates(company.signed(request.public_key(), ["10.9.9.9"]))
    bare.write_bytes(leaf.public_bytes(Encoding.PEM))
    noise, absent = tmp_path / "noise.pem", tmp_path / "absent.pem"
    noise.write_text("x")
    done = tod("keys", f"output={keys}", f"signed={other},{late},{bare},{noise},{absent}")
    ended = f"{datetime.now(UTC) - timedelta(days=35):%Y-%m-%d}"
    missing = "the certificate of 'CN=Acme Issuing', which issued it, is missing: append it to this file"
    assert done.status == 2
    lines = done.err.splitlines()
    assert lines[:4] == [
        f"{other}: is for none of the requests in {keys / 'requests'}: its key is another one",
        f"{late}: controller alice: expired on {ended}",
        f"{bare}: vehicle car: lacks 10.0.0.2 (subject alternative name)",
        f"{bare}: vehicle car: {missing}",
    ]
    assert lines[4].startswith(f"{noise}: must be a certificate (PEM): ")
    assert lines[5] == f"{absent}: must be a certificate (PEM): no such file"
    assert lines[6] == "6 problems, nothing was taken in"
    assert sorted(os.listdir(keys)) == ["authority", "requests"]


@pytest.mark.parametrize(
    "words, why",
    [
        ("ca={issuing}", "must contain the authority's root, one self-signed certificate, not 0"),
        ("ca={absent}", "no such file"),
        ("signed={root}", "signed: {root}: is for keys of another authority: give ca=FILE first, its certificates"),
    ],
)
def test_what_is_no_authority_is_named(tod, company, tmp_path, words, why):
    files = {"root": company.ca, "issuing": company.directory / "issuing.pem", "absent": tmp_path / "absent"}
    done = tod("keys", f"output={tmp_path / 'keys'}", words.format(**files))
    assert done.status == 2
    assert why.format(**files) in done.err


def test_a_directory_that_lacks_the_known_keys_is_refused(complete):
    (complete / "car" / "holders.json").unlink()
    with pytest.raises(UserError, match=r"holders\.json: no such file"):
        Keyring.of(complete / "car")


RULES_OF_BOB = """
# bob, a watcher, writes requests and reports that end in its name, and reads what vehicles publish and answer to bob:
user bob
topic write acme/tod/+/request/bob
topic write acme/tod/+/reception/bob
topic read acme/tod/+/state
topic read acme/tod/+/telemetry
topic read acme/tod/+/configuration
topic read acme/tod/+/advice
topic read acme/tod/+/steering
topic read acme/tod/+/reply/bob
topic read acme/tod/+/clock/bob
"""


def test_rules_for_another_broker_are_printed(tod, tmp_path):
    output = f"output={tmp_path / 'keys'}"
    tod("keys", output, "watcher=bob")
    printed = tod("keys", output, "rules=true", "prefix=acme/tod")
    words, _, rules = printed.out.partition("\n\n")
    assert all(line.startswith("#") for line in words.splitlines())
    assert f"\n{rules}" == RULES_OF_BOB
    refused = tod("keys", output, "rules=true", "revoke=bob")
    assert refused.err.strip() == "command line: rules: true: must come without revoke: it changes nothing"
