"""Checks of a flight name what its user can set."""

import pytest

from scenematch.check import Finding
from scenematch.check.causes import IN_CALIBRATION
from scenematch.runs.checking import _that_can_be_set

LINE = "mount: [0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]"


def cure(text, *, gimbal=False, calibration=True, cause="mount"):
    return _that_can_be_set(Finding(cause, "it hangs off", text), gimbal, calibration).cure


def test_a_mount_is_written_where_there_is_a_calibration_or_can_be():
    assert cure(LINE + IN_CALIBRATION) == f"{LINE} in the calibration"
    assert cure(LINE + IN_CALIBRATION, calibration=False) == f"write a calibration file with {LINE}, for --camera"
    assert cure("--mount nadir-tail", calibration=False) == "--mount nadir-tail"


@pytest.mark.parametrize("text", [LINE + IN_CALIBRATION, "--mount nadir-tail"])
def test_beside_a_gimbal_its_angles_are_corrected(text):
    assert cure(text, gimbal=True).startswith("the gimbal's angles replace a mount: correct the angles")
    assert cure("--correct angles=radians", gimbal=True, cause="radians") == "--correct angles=radians"
