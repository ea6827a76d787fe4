"""The benchmark of GPUs on a machine without one: its table and its counting."""

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
    tasks = ["NCC 228 in 425", "NCC surfaces, 1", "SIFT of 1", "locate, ncc", "locate, sift", "whole map, ncc"]
    assert [row[0].strip("| ") for row in rows] == ["task", *tasks]
    assert {len(row) for row in rows} == {len(gpu.COLUMNS)}
    assert [row[5] for row in rows[1:]] == ["0e+00 px, 0e+00", "0e+00", "100.0% shared", *["0e+00 m"] * 3]


def test_a_row_has_times_beside_those_of_its_peers():
    row = gpu.Row("x", ([2.0, 2.0, 2.0], [3.0, 4.0, 9.0], []), "0", (1, 1))
    assert row.cells() == ["x", "2.000", "2.000", "4.000", "", "0", "1", "1"]


def test_copies_are_told_apart_by_their_direction():
    up, within, down = "HtoD (Pinned -> Device)", "DtoD (Device -> Device)", "DtoH (Device -> Pageable)"
    copies = [f"Memcpy {way}" for way in (up, within, down, up)]
    assert gpu.directions([*copies, "vectorized_elementwise_kernel"]) == (2, 1)
