"""The last fix of a bridge: found by the process that takes over, and by no other."""

from __future__ import annotations

import time
from types import SimpleNamespace

import pytest

from scenematch.runs import last_fix
from scenematch.runs.last_fix import LastFix, last_fix_file

FIX = SimpleNamespace(lat_deg=48.2, lon_deg=16.37, sigma_m=0.5)


def test_it_grows_uncertain_while_nobody_watches(monkeypatch):
    memory, clock = LastFix(), SimpleNamespace(now_s=time.monotonic())
    monkeypatch.setattr(last_fix.time, "monotonic", lambda: clock.now_s)
    assert memory.prior(15.0) is None
    memory.keep(FIX)
    clock.now_s += 0.1
    prior = memory.prior(15.0)
    assert (prior.lat_deg, prior.lon_deg) == (48.2, 16.37)
    assert prior.sigma_m == pytest.approx(0.5 + 15.0 * 0.1)


def test_another_finds_it_though_the_first_closed_nothing_as_one_that_is_killed(tmp_path):
    first = LastFix(tmp_path / "cache" / "last-fix")
    first.keep(FIX)
    prior = LastFix(tmp_path / "cache" / "last-fix").prior(15.0)
    assert (prior.lat_deg, prior.lon_deg) == (48.2, 16.37)


def test_it_is_forgotten_after_a_minute_and_when_the_computer_starts_again(tmp_path, monkeypatch):
    memory = LastFix(tmp_path / "last-fix")
    memory.keep(FIX)
    for now_s in (time.monotonic() + 61.0, 1.0):  # a clock that began anew
        with monkeypatch.context() as patch:
            patch.setattr(last_fix.time, "monotonic", lambda now_s=now_s: now_s)
            assert memory.prior(15.0) is None
    boot = tmp_path / "boot_id"
    boot.write_text("0f0e0d0c-0b0a-0908-0706-050403020100\n", encoding="ascii")
    monkeypatch.setattr(last_fix, "_BOOT_ID", boot)
    assert LastFix(tmp_path / "last-fix").prior(15.0) is None


@pytest.mark.parametrize("cut", [1, 20, 50])
def test_one_that_was_half_written_is_none(tmp_path, cut):
    path = tmp_path / "last-fix"
    LastFix(path).keep(FIX)
    whole = path.read_bytes()
    path.write_bytes(whole[:cut] + bytes(len(whole) - cut))
    assert LastFix(path).prior(15.0) is None


def test_a_folder_that_cannot_be_written_keeps_it_in_the_process(tmp_path):
    (tmp_path / "file").write_text("")
    memory = LastFix(tmp_path / "file" / "last-fix")
    memory.keep(FIX)
    assert memory.prior(15.0) is not None


def test_each_link_and_map_has_its_own():
    names = {last_fix_file(link, site) for link in ("serial:/dev/ttyAMA0:921600", "tcp:1") for site in ("a", "b")}
    assert len(names) == 4
