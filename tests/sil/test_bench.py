"""make bench: what would make its figures missing, or wrong by much."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT_PATH = Path(__file__).resolve().parents[2]

FACTORS = ("sil", "mujoco", "mujoco_rk4", "scipy_rk45", "scipy_lsoda", "numpy")


@pytest.mark.skipif(sys.version_info < (3, 11), reason="MuJoCo's wheels begin with Python 3.11")
@pytest.mark.timeout(600)  # it compiles first
def test_bench_does_not_leave_out_a_figure_or_get_one_wrong_by_much(tmp_path: Path) -> None:
    """GIVEN a quick bench WHEN its ratios are looked at THEN each is there and of the right size, from both sides."""
    path = tmp_path / "bench.json"
    command = [sys.executable, "tools/bench.py", "--quick", "--json", str(path)]
    done = subprocess.run(command, cwd=ROOT_PATH, capture_output=True, text=True, timeout=580, check=False)
    assert done.returncode == 0, done.stderr
    result = json.loads(path.read_text(encoding="utf-8"))

    factor = {name: result[f"{name}_realtime_factor"] for name in FACTORS}
    assert 10 < factor["sil"] / factor["scipy_lsoda"] < 2000 and 10 < factor["sil"] / factor["scipy_rk45"] < 2000
    assert 0.3 < factor["sil"] / factor["mujoco"] < 50
    assert 1.2 < factor["mujoco"] / factor["mujoco_rk4"] < 20
    assert factor["numpy"] < factor["scipy_rk45"]
    share = result["share"]
    assert sum(share.values()) == pytest.approx(1.0)
    assert 0.05 < share["ecu"] < 0.9 and 0.05 < share["plant"] < 0.9
    assert 0.05 < result["ecu_tick_ns"]["double"] / result["ecu_tick_ns"]["fixed"] < 2.0
    assert 0.1 < result["plant_tick_ns"] / result["loop_tick_ns"] < 1.0
    for name in ("sil", "scipy_rk45", "scipy_lsoda", "numpy"):
        assert 1e-13 < result["error_rad"][name] < 1e-6, name
    assert result["error_rad"]["mujoco_rk4"] < result["error_rad"]["mujoco"] < 0.1
    assert 0.1 < result["campaign_efficiency_2_workers"] < 2.0
    duration = result["growth"]["duration"]
    assert duration[-1]["session_bytes"] > 1.3 * duration[0]["session_bytes"]
    assert path.with_suffix(".png").stat().st_size > 10_000


def test_bench_does_not_run_for_minutes_before_it_says_that_it_cannot_write(tmp_path: Path) -> None:
    """GIVEN a JSON file in a folder that cannot be made WHEN started THEN status 2 and a message that names it."""
    path = tmp_path / "no" / "such" / "bench.json"
    command = [sys.executable, "tools/bench.py", "--quick", "--json", str(path)]
    done = subprocess.run(command, cwd=ROOT_PATH, capture_output=True, text=True, timeout=100, check=False)
    assert done.returncode == 2
    assert "bench:" in done.stderr and "no" in done.stderr and "Traceback" not in done.stderr
