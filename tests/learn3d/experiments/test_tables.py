"""The tables: figures of the paper, rows, presets."""

from __future__ import annotations

import runpy

import numpy as np
import pytest

from learn3d.experiments import published
from learn3d.experiments.experiment import describe_tables
from learn3d.experiments.tables import TABLES, VARIANTS
from learn3d.presets import METHODS, PRESETS


@pytest.mark.parametrize("name", ["KATO", "PRGAN", "KAR", "ABLATION", "MMD", "PASCAL"])
def test_printed_means_agree_with_the_printed_rows(name: str) -> None:
    for label, row in getattr(published, name).items():
        if row.mean is not None:
            assert np.mean(list(row.values.values())) == pytest.approx(row.mean, abs=0.001), label


def test_a_method_of_ones_own_leaves_the_tables_alone(monkeypatch) -> None:
    monkeypatch.setitem(METHODS, "mine", METHODS["plus"])
    assert runpy.run_module("learn3d.experiments.tables")["TABLES"].keys() == TABLES.keys()


def test_rows_name_variants_baselines_and_published_figures() -> None:
    used = {variant for table in TABLES.values() for variant in table.rows.values() if variant}
    assert used == set(VARIANTS), "every variant is a row of a table"
    assert {variant.preset for variant in VARIANTS.values()} <= set(PRESETS)
    for table in TABLES.values():
        assert table.baseline in table.rows
        assert set(table.published) <= set(table.rows)
        assert all(variant or label in table.published for label, variant in table.rows.items())
    assert TABLES["kar"].rows["Proposed"] in TABLES["bins"].rows.values()


def test_the_list_has_every_table_with_its_rows() -> None:
    lines = describe_tables().splitlines()
    for name, table in TABLES.items():
        start = lines.index(f"{name}: {table.title}") + 2
        for line, (label, variant) in zip(lines[start:], table.rows.items(), strict=False):
            assert line.startswith(f"  {label}: {variant or 'quoted'}"), line
    assert "  w/o prior: without-prior, preset peng2020-kato, lambda_prior=0" in describe_tables()
