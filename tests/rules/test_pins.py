"""Releases that are pinned in two places."""

from __future__ import annotations

from sil_plant.config import ROOT, tomllib


def test_extra_is_not_pinned_otherwise_than_the_requirements() -> None:
    """GIVEN the extras of pyproject.toml WHEN compared THEN each release is the one of requirements.txt."""
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["optional-dependencies"]
    lines = (ROOT / "requirements.txt").read_text("utf-8").splitlines()
    pinned = {line.partition(";")[0].strip() for line in lines if "==" in line}
    assert {"live", "mf4", "test"} <= set(extras)
    for name, wanted in extras.items():
        assert [each for each in wanted if each.partition(";")[0].strip() not in pinned] == [], name
