"""The record of a run in summary.json: read back as it was written, refused in one line where it was spoiled."""

import json
import re
from dataclasses import fields

import pytest

from engine.errors import OptionError, TelemetryError
from engine.geo import LocalFrame
from scenematch.files.corrections import Corrections
from scenematch.files.settings import nested
from scenematch.runs.record import RunRecord, read_record
from tests.support.refusals import refusal

RECORD = RunRecord(
    map="/m.tif", surface=None, camera="/c.yaml", frames="/f", telemetry="/t.BIN", truth=None,
    frame_stamps="/s.csv", log_offset_s=0.5, heights={"take-off": 3},
    corrections=Corrections(columns=("roll_deg=-roll_deg",), offset_s=0.3), method="ncc", profile="engine",
    device="cpu", changed={"errors.map_m": 1.0}, origin=LocalFrame(48.0, 16.0),
    ground_m=3.5, ground_amsl_m=None, more={"closed_loop": {"minutes": 1.0}},
)  # fmt: skip


def kind_of(field):
    return re.match(r"\w+", field.type)[0]


WRONG = {
    "str": (5, True, [1]), "float": (True, "x"), "int": (True, "x", 1.5), "bool": (5, "x"),
    **dict.fromkeys(("dict", "Corrections", "LocalFrame"), (5, "x", [1])),
}  # fmt: skip
"""What a field refuses, by its type."""
CASES = [
    *((each.name, value) for each in fields(RunRecord) if each.name != "more" for value in WRONG[kind_of(each)]),
    *((name, {"a": None}) for name in ("heights", "origin", "corrections", "diagnosis")),
]


def write(folder, settings):
    path = folder / "summary.json"
    path.write_text(json.dumps({"settings": settings}), encoding="utf-8")
    return path


def test_a_record_is_read_as_it_was_written(tmp_path):
    assert read_record(write(tmp_path, RECORD.facts())) == RECORD


@pytest.mark.parametrize(("name", "value"), CASES)
def test_a_value_of_another_kind_is_told_by_name(name, value, tmp_path):
    path = write(tmp_path, RECORD.facts() | {name: value})
    expected = f"{path}: expected the summary that track writes; settings, {name}"
    assert refusal(read_record, path).startswith(expected)


@pytest.mark.parametrize("name", ["map", "method", "origin", "ground_m"])
def test_a_record_that_lacks_what_evaluate_needs_is_refused(name, tmp_path):
    settings = RECORD.facts()
    del settings[name]
    with pytest.raises(TelemetryError, match="expected the summary that track writes, got something else"):
        read_record(write(tmp_path, settings))


def test_a_setting_within_another_is_refused():
    with pytest.raises(OptionError, match=r"ncc\.rule: expected a setting inside a table, but ncc is a setting"):
        nested({"ncc": 5, "ncc.rule": 1})
