"""The benchmark of GPUs on a machine without one: its table and its counting."""

from __future__ import annotations

import pytest
import torch

from bench import gpu


def test_without_cuda_it_says_so_in_one_line(capsys, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    gpu.main([])
    out = capsys.readouterr().out
    assert out.startswith("no GPU was measured: ")
    assert out.count("\n") == 1


@pytest.mark.slow
def test_the_table_has_a_row_for_every_task(capsys):
    gpu.main(["--device", "cpu", "--quick"])
    rows = [line.split(" | ") for line in capsys.readouterr().out.splitlines() if line.startswith("| ")]
    assert [row[0].strip("| ") for row in rows] == [
        "task",
        "NCC 228 in 425",
        "locate, ncc",
        "locate, sift",
    ]
    assert {len(row) for row in rows} == {len(gpu.COLUMNS)}
    assert [row[4] for row in rows[2:]] == ["0e+00 m"] * 2  # the CPU beside itself


def test_a_row_has_times_and_their_rate():
    row = gpu.Row("x", [2.0, 2.0, 2.0], "0", (1, 1))
    assert row.cells() == ["x", "2.000", "2.000", "500", "0", "1", "1"]


def test_copies_are_told_apart_by_their_direction():
    names = [
        "Memcpy HtoD (Pinned -> Device)",
        "Memcpy DtoD (Device -> Device)",
        "Memcpy DtoH (Device -> Pageable)",
    ]
    assert gpu.directions([*names, "vectorized_elementwise_kernel", names[0]]) == (2, 1)
