"""`verify`, and `info --decisions`, on logs that were planned and on others."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner

import spatial_replay as sr
from cli.program import PROGRAM, written_on_terminal
from planning.plans import PUSH, record_plan_of, write_usual_run
from spatial_replay.bags.open import open_messages
from spatial_replay.cli.application import application
from spatial_replay.logs.mcap.write import LogWriter
from spatial_replay.logs.schemas.ObjectStates_pb2 import ObjectStates
from spatial_replay.logs.topics import CERTIFICATE, OBJECTS
from spatial_replay.replay.verification import statement


def call(*arguments: object) -> tuple[int, str]:
    result = CliRunner().invoke(application, [str(each) for each in arguments], standalone_mode=False)
    if result.exception is not None:
        raise result.exception
    return int(result.return_value), result.output


@pytest.fixture
def recorded(tmp_path: Path) -> Path:
    specification = sr.parse_specification("F (a leftof b)")
    with sr.Recorder(tmp_path / "run.mcap", specifications=specification) as recorder:
        for k in range(40):
            box = sr.Footprint.box(20 - k, 0, 21 - k, 1)
            recorder.write(sr.Sample(k * 10**8, {"a": box, "b": sr.Footprint.disc(5, 5, 1)}))
    return tmp_path / "run.mcap"


def test_an_unchanged_log_is_verified(recorded: Path) -> None:
    code, said = call("verify", recorded)
    assert code == 0
    assert "results match" in said


def test_an_annotated_log_is_verified_alone_and_against_its_source(recorded: Path, tmp_path: Path) -> None:
    call("replay", recorded, "-o", tmp_path / "annotated.mcap", "--from", "1s", "--every", "2")
    assert call("verify", tmp_path / "annotated.mcap")[0] == 0
    assert call("verify", tmp_path / "annotated.mcap", "--source", recorded)[0] == 0


def test_a_layer_is_verified_against_its_source(recorded: Path, tmp_path: Path) -> None:
    call("replay", recorded, "-o", tmp_path / "layer.mcap", "--layer")
    assert call("verify", tmp_path / "layer.mcap", "--source", recorded)[0] == 0
    with pytest.raises(sr.UsageError, match="--source"):
        call("verify", tmp_path / "layer.mcap")


def test_a_different_source_is_detected(recorded: Path, tmp_path: Path) -> None:
    with sr.Recorder(tmp_path / "other.mcap") as recorder:
        recorder.write(sr.Sample(0, {"a": sr.Footprint.disc(1, 1, 1), "b": sr.Footprint.disc(5, 5, 1)}))
    code, said = call("verify", recorded, "--source", tmp_path / "other.mcap")
    assert code == 1
    assert "other samples" in said
    assert "other results" in said
    assert "another specification" not in said


def test_a_truncated_log_has_no_certificate(recorded: Path, tmp_path: Path) -> None:
    (tmp_path / "cut.mcap").write_bytes(recorded.read_bytes()[: recorded.stat().st_size // 2])
    code, said = call("verify", tmp_path / "cut.mcap")
    assert code == 1
    assert "no certificate" in said


def test_decisions_are_recomputed(tmp_path: Path) -> None:
    write_usual_run(tmp_path / "run.mcap")
    code, said = call("verify", tmp_path / "run.mcap", "--decisions")
    assert code == 0
    assert "3 decisions recomputed with 9 maps" in said


def test_decisions_that_differ_are_reported(tmp_path: Path) -> None:
    record_plan_of(tmp_path / "run.mcap", recorded_settings=replace(PUSH, margin=0.03))
    code, said = call("verify", tmp_path / "run.mcap", "--decisions")
    assert code == 1
    assert "of decision 0" in said


def test_decisions_of_the_source_are_recomputed(tmp_path: Path) -> None:
    write_usual_run(tmp_path / "run.mcap")
    call("replay", tmp_path / "run.mcap", "-o", tmp_path / "layer.mcap", "--layer")
    call("replay", tmp_path / "run.mcap", "-o", tmp_path / "cut.mcap", "--from", "50ms")
    for name in ("layer.mcap", "cut.mcap"):
        code, said = call("verify", tmp_path / name, "--decisions", "--source", tmp_path / "run.mcap")
        assert code == 0
        assert "run.mcap: 3 decisions recomputed with 9 maps" in said
    with pytest.raises(sr.UsageError, match="begins within the run"):
        call("verify", tmp_path / "cut.mcap", "--decisions")


def test_decisions_are_printed_step_by_step(tmp_path: Path) -> None:
    write_usual_run(tmp_path / "run.mcap", slips=1)
    code, said = call("info", tmp_path / "run.mcap", "--decisions")
    lines = said.splitlines()
    assert code == 0
    assert lines[0].startswith("run.mcap: 4 decisions for 'push', 3 motions")
    assert next(line for line in lines if line.startswith("decision ")) == "decision 0 at 0.000 s, state 0"
    assert "    given up: no object can do it" in lines
    assert any(line.startswith("  failed at") and "it slipped" in line for line in lines)
    assert any("chosen" in line for line in lines)
    assert lines[-2:] == ["  the specification is satisfied: hold", "given up: 0 -> 3: no object can do it"]


def test_decisions_fit_the_terminal(tmp_path: Path) -> None:
    write_usual_run(tmp_path / "run.mcap")
    said = written_on_terminal((*PROGRAM, "info", "run.mcap", "--decisions"), tmp_path, {"COLUMNS": "70"})
    assert max(map(len, said.splitlines())) <= 70
    _, whole = call("info", tmp_path / "run.mcap", "--decisions", "--json")
    printed = " ".join(said.split())
    for edge in json.loads(whole)["decisions"][0]["considered"]:
        assert f"wanted {edge['wanted'][0]}".replace("`", "") in printed


def test_a_motion_cut_off_by_the_end_of_the_log_is_marked(tmp_path: Path) -> None:
    def seen(sample: sr.Sample) -> sr.Sample:
        if sample.time_ns > 10**8:
            raise KeyboardInterrupt
        return sample

    with pytest.raises(KeyboardInterrupt):
        record_plan_of(tmp_path / "run.mcap", recorded_as=seen)
    _, said = call("info", tmp_path / "run.mcap", "--decisions")
    lines = said.splitlines()
    assert lines[0] == "run.mcap: 2 decisions for 'push', 1 motion and one cut short"
    assert lines[-2] == "  the log ends during this motion"


def test_decisions_of_a_truncated_log_are_printed(tmp_path: Path) -> None:
    write_usual_run(tmp_path / "run.mcap", slips=1)
    whole = (tmp_path / "run.mcap").read_bytes()
    # the samples of so short a run come after its maps
    (tmp_path / "cut.mcap").write_bytes(whole[: whole.index(b"spatial_replay_certificate")])
    code, said = call("info", tmp_path / "cut.mcap", "--decisions")
    assert code == 3
    assert "decision 0 at 0.000 s, state 0" in said
    code, said = call("verify", tmp_path / "cut.mcap", "--decisions")
    assert code == 1
    assert "recomputed" in said
    assert "no certificate" in said


def test_decisions_are_available_as_json(tmp_path: Path) -> None:
    write_usual_run(tmp_path / "run.mcap")
    code, said = call("info", tmp_path / "run.mcap", "--decisions", "--json")
    decisions = json.loads(said)["decisions"]
    assert code == 0
    assert [each["kind"] for each in decisions] == ["execute", "execute", "hold"]
    assert decisions[0]["time_ns"] == 0
    assert decisions[0]["outcome"]["succeeded"] is True
    assert decisions[0]["target"]["object"] in {"red", "blue"}


def test_infinite_numbers_are_written_as_in_other_json(tmp_path: Path) -> None:
    everywhere = sr.Footprint.box(-1, -1, 2, 2)
    walled = replace(PUSH, workspace=replace(PUSH.workspace, obstacles=(everywhere,)))
    record_plan_of(tmp_path / "run.mcap", settings=walled)
    _, said = call("info", tmp_path / "run.mcap", "--decisions", "--json")
    candidates = json.loads(said)["decisions"][0]["considered"][0]["candidates"]
    assert [each["best"] for each in candidates] == ["-inf", "-inf", "-inf"]


def test_a_log_without_decisions_is_wrong_usage(recorded: Path) -> None:
    with pytest.raises(sr.UsageError, match="holds no decisions"):
        call("info", recorded, "--decisions")
    with pytest.raises(sr.UsageError, match="holds no decisions"):
        call("verify", recorded, "--decisions")


def test_a_mapping_requires_a_source(recorded: Path) -> None:
    with pytest.raises(sr.UsageError, match="add --source"):
        call("verify", recorded, "--mapping", "m.yaml")


def test_a_source_is_read_as_it_was_when_the_log_was_made(tmp_path: Path) -> None:
    boxes, spec = tmp_path / "annotations.txt", tmp_path / "near.spatial"
    boxes.write_text('1 0 10 4 20 0 0 0 0 "Biker"\n2 0 40 4 50 9 1 0 0 "Biker"\n')
    spec.write_text('F ("1" above "2")\n')
    call(
        "replay",
        boxes,
        "--spec",
        spec,
        "--read",
        "y_down=false",
        "--read",
        "rate=10",
        "--read",
        "lost=keep",
        "-o",
        tmp_path / "a.mcap",
    )
    assert call("verify", tmp_path / "a.mcap", "--source", boxes)[0] == 0
    assert call("verify", tmp_path / "a.mcap", "--source", boxes, "--read", "y_down=true")[0] == 1


def explained(said: str) -> dict[str, str]:
    """What `--explain` says of each part."""
    lines = (line.partition(" ")[::2] for line in map(str.strip, said.splitlines()))
    return {part: what.strip() for part, what in lines}


def rewritten(path: Path, output: Path, change: Callable[[str, int, bytes], bytes]) -> Path:
    """A copy of a log with other messages; its certificate stays."""
    reader = open_messages(path)
    names = {topic.name for topic in reader.topics()}
    channels = {channel.topic: channel for channel in reader.channels(names).values()}
    with output.open("wb") as stream, LogWriter(stream) as writer:
        for name, data in reader.metadata():
            writer.add_metadata(name, data)
        for each in reader.attachments():
            writer.add_attachment(each.name, each.media_type, each.data)
        for message in reader.iter_messages(names):
            payload = change(message.topic, message.log_time_ns, message.payload)
            channel = channels[message.topic]
            writer.write(channel, message.log_time_ns, payload, sequence=message.sequence)
    return output


def test_where_results_differ_first_is_explained(recorded: Path, tmp_path: Path) -> None:
    def change(topic: str, time_ns: int, payload: bytes) -> bytes:
        if topic == OBJECTS and time_ns >= 7 * 10**8:
            states = ObjectStates.FromString(payload)
            corners = states.objects[0].parts[0].coordinates
            corners[::2] = [x - 0.5 for x in corners[::2]]
            return states.SerializeToString(deterministic=True)
        return payload

    changed = rewritten(recorded, tmp_path / "changed.mcap", change)
    code, said = call("verify", changed, "--explain")
    assert code == 1
    parts = explained(said)
    assert parts["samples"].startswith("differ from those certified")
    assert parts["specification"] == "the same"
    assert parts["program"] == "the same"
    assert parts["results"].startswith("differ first at 0.700 s: ")
    assert " now, " in parts["results"] and " recorded" in parts["results"]


def test_what_is_equal_is_explained_as_well(recorded: Path) -> None:
    code, said = call("verify", recorded, "--explain")
    assert code == 0
    parts = explained(said)
    names = ("samples", "messages", "specification", "results", "program")
    assert [parts[name] for name in names] == ["the same"] * 5
    assert sr.verify(recorded, explain=True).explanation[-1].split(maxsplit=1) == ["program", "the same"]


def test_which_sample_and_message_differ_from_the_source_is_explained(recorded: Path, tmp_path: Path) -> None:
    def change(topic: str, time_ns: int, payload: bytes) -> bytes:
        if topic == OBJECTS and time_ns == 12 * 10**8:
            states = ObjectStates.FromString(payload)
            states.objects[1].yaw = 1.0
            return states.SerializeToString(deterministic=True)
        return payload

    call("replay", recorded, "-o", tmp_path / "annotated.mcap")
    other = rewritten(recorded, tmp_path / "run2.mcap", change)
    code, said = call("verify", tmp_path / "annotated.mcap", "--source", other, "--explain")
    assert code == 1
    parts = explained(said)
    assert parts["samples"] == "differ first at 1.200 s: `b` has another yaw"
    assert parts["results"] == "the same"


def test_another_version_and_another_specification_are_explained(recorded: Path, tmp_path: Path) -> None:
    data = recorded.read_bytes()
    reader = open_messages(recorded)
    names = {topic.name for topic in reader.topics()}
    channels = reader.channels(names)
    with (tmp_path / "other.mcap").open("wb") as stream, LogWriter(stream) as writer:
        for name, record in reader.metadata():
            changed = {"spatial_replay_version": "0.0.1"} if name == CERTIFICATE else {}
            writer.add_metadata(name, {**record, **changed})
        for each in reader.attachments():
            text = (
                each.data.replace(b"leftof", b"rightof") if each.name.startswith("recorded/") else each.data
            )
            writer.add_attachment(each.name, each.media_type, text)
        for message in reader.iter_messages(names):
            channel = next(each for each in channels.values() if each.topic == message.topic)
            writer.write(channel, message.log_time_ns, message.payload, sequence=message.sequence)
    assert recorded.read_bytes() == data
    code, said = call("verify", tmp_path / "other.mcap", "--explain")
    parts = explained(said)
    assert code == 1
    assert parts["program"].endswith("now, 0.0.1 recorded")
    assert "as formatted: `spec" in parts["specification"]
    assert "rightof" in parts["specification"] and "leftof" in parts["specification"]
    assert parts["samples"] == parts["messages"] == "the same"


@pytest.fixture
def keys(tmp_path: Path) -> tuple[Path, Path]:
    """Two SSH keys without a passphrase."""
    if shutil.which("ssh-keygen") is None:
        pytest.skip("ssh-keygen is not installed")
    paths = tmp_path / "own", tmp_path / "other"
    for path in paths:
        make = ["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-C", f"{path.name}@robot", "-f", str(path)]
        subprocess.run(make, check=True)
    return paths


def test_a_signed_certificate_names_its_signer(
    recorded: Path, keys: tuple[Path, Path], tmp_path: Path
) -> None:
    own, other = keys
    code, said = call("verify", recorded, "--sign", own)
    assert code == 0
    assert (tmp_path / "run.mcap.sig").read_text().startswith("-----BEGIN SSH SIGNATURE-----")
    code, said = call("verify", recorded, "--signer", own.with_suffix(".pub"))
    assert code == 0
    assert "signed by own@robot" in said
    people = tmp_path / "allowed_signers"
    lines = [
        f"{name}@lab {key.with_suffix('.pub').read_text()}" for name, key in (("ann", other), ("ben", own))
    ]
    people.write_text("# people\n" + "".join(lines))
    code, said = call("verify", recorded, "--signer", people)
    assert code == 0
    assert "signed by ben@lab" in said


def test_a_signature_of_another_person_log_or_purpose_does_not_fit(
    recorded: Path, keys: tuple[Path, Path], tmp_path: Path
) -> None:
    own, other = keys
    call("verify", recorded, "--sign", own)
    code, said = call("verify", recorded, "--signer", other.with_suffix(".pub"))
    assert code == 1
    assert "no signature of its certificate by anyone in other.pub" in said
    call("replay", recorded, "-o", tmp_path / "half.mcap", "--to", "2s")
    code, said = call(
        "verify",
        tmp_path / "half.mcap",
        "--signer",
        own.with_suffix(".pub"),
        "--signature",
        f"{recorded}.sig",
    )
    assert code == 1
    mail = statement(dict(open_messages(recorded).metadata())[CERTIFICATE])
    make = ["ssh-keygen", "-Y", "sign", "-f", str(own), "-n", "file"]
    signed = subprocess.run(make, input=mail, capture_output=True, check=True).stdout
    (tmp_path / "mail.sig").write_bytes(signed)
    code, said = call(
        "verify", recorded, "--signer", own.with_suffix(".pub"), "--signature", tmp_path / "mail.sig"
    )
    assert code == 1


def test_only_a_right_certificate_is_signed(recorded: Path, keys: tuple[Path, Path], tmp_path: Path) -> None:
    changed = rewritten(
        recorded,
        tmp_path / "changed.mcap",
        lambda topic, time_ns, payload: b"" if topic == OBJECTS else payload,
    )
    with pytest.raises(sr.LogError):
        call("verify", changed, "--sign", keys[0])
    with pytest.raises(sr.UsageError, match="cannot sign"):
        call("verify", recorded, "--sign", recorded)
    with pytest.raises(sr.UsageError, match=r"run[.]mcap[.]sig"):
        call("verify", recorded, "--signer", keys[0].with_suffix(".pub"))
    assert not list(tmp_path.glob("*.sig"))
