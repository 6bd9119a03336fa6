"""What happens in a run: moves, load over time, duration, changes to the plant. docs/scenario.md has the format."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field, replace
from pathlib import Path

from sil_plant.config import ROOT, ConfigError, TomlFile, flatten
from sil_plant.inputs.faults import Fault, outside_run, read_faults
from sil_plant.inputs.machine import JOINT_NAMES, Machine

SCENARIOS = ROOT / "sil_plant" / "scenarios"
DEFAULT_SCENARIO = SCENARIOS / "paper.toml"

LONGEST_RUN_S = 3600.0
LONGEST_MOVE_S = 65.0
SHORTEST_MOVE_S = 0.05
HEAVIEST_KG = 1e4


@dataclass(frozen=True)
class Segment:
    """One move of one joint and the rest after it."""

    target_rad: float
    duration_s: float
    dwell_s: float


@dataclass(frozen=True)
class LoadStep:
    """From this time on the load is this."""

    time_s: float
    load_kg: float


@dataclass(frozen=True)
class Scenario:
    """A checked scenario file.

    Attributes
    ----------
    name : str
        As the file says.
    duration_s : float
        From the start of motion.
    seed : int
        Of the sensor noise.
    start_pose_rad : tuple
        Swing, wrist.
    segments : tuple
        Moves of swing and of wrist.
    repeat : bool
        Begin again when a joint's segments are through.
    load : tuple
        Steps in order of time; the first at 0.
    plant : dict
        Dotted keys of the machine file, and the plant's values in their place.
    faults : tuple
        What breaks on purpose, and when.
    source : TomlFile or None
        Where it was read from, for messages.
    """

    name: str
    duration_s: float
    seed: int
    start_pose_rad: tuple[float, float]
    segments: tuple[tuple[Segment, ...], tuple[Segment, ...]]
    repeat: bool
    load: tuple[LoadStep, ...]
    plant: dict[str, float] = field(default_factory=dict)
    faults: tuple[Fault, ...] = ()
    source: TomlFile | None = None


TOP_KEYS = {"name", "duration_s", "seed", "start_pose_rad", "repeat", "load", "plant", "faults", *JOINT_NAMES}
SEGMENT_KEYS = {"target_rad", "duration_s", "dwell_s"}


def load_scenario(path: Path) -> Scenario:
    """Read and check a scenario file.

    Raises
    ------
    ConfigError
        Naming file, line, key and range.
    """
    toml = TomlFile(path)
    data = toml.data
    for key in data:
        if key not in TOP_KEYS:
            raise toml.error(key, f"is not a key of a scenario; known are {', '.join(sorted(TOP_KEYS))}")
    pose = data.get("start_pose_rad", [0.0, 0.0])
    if not isinstance(pose, list) or len(pose) != len(JOINT_NAMES):
        raise toml.error("start_pose_rad", "two angles are needed: [swing, wrist]")
    seed = data.get("seed", 1)
    if isinstance(seed, bool) or not isinstance(seed, int) or not 0 <= seed < 2**63:
        raise toml.error("seed", "a whole number from 0 is needed")
    repeat = data.get("repeat", False)
    if not isinstance(repeat, bool):
        raise toml.error("repeat", "true or false is needed")
    name = data.get("name", path.stem)
    if not isinstance(name, str):
        raise toml.error("name", "a text is needed")
    plant = data.get("plant", {})
    if not isinstance(plant, dict):
        raise toml.error("plant", "a table [plant] is needed")
    return Scenario(
        name=name,
        duration_s=toml.number("duration_s", data.get("duration_s", 10.0), 0.01, LONGEST_RUN_S),
        seed=seed,
        start_pose_rad=(
            toml.number("start_pose_rad", pose[0], -3.14, 3.14),
            toml.number("start_pose_rad", pose[1], -3.14, 3.14),
        ),
        segments=(_segments(toml, "swing"), _segments(toml, "wrist")),
        repeat=repeat,
        load=_load_steps(toml),
        plant={key: toml.number(f"plant.{key}", value, -1e12, 1e12) for key, value in flatten(plant)},
        faults=read_faults(toml),
        source=toml,
    )


def _segments(toml: TomlFile, joint: str) -> tuple[Segment, ...]:
    table = toml.data.get(joint, {})
    items = table.get("segment", []) if isinstance(table, dict) else None
    if not isinstance(items, list) or (isinstance(table, dict) and set(table) - {"segment"}):
        raise toml.error(joint, f"a list of tables [[{joint}.segment]] is needed, and nothing else")
    segments = []
    for n, item in enumerate(items):
        key = f"{joint}.segment"
        if not isinstance(item, dict):
            raise toml.error(key, "a table with target_rad, duration_s and dwell_s is needed", n)
        for name in item:
            if name not in SEGMENT_KEYS:
                raise toml.error(f"{key}.{name}", f"is not a key of a segment; known are {sorted(SEGMENT_KEYS)}", n)
        for name in ("target_rad", "duration_s"):
            if name not in item:
                raise toml.error(key, f"{name} is missing", n)
        segments.append(
            Segment(
                target_rad=toml.number(f"{key}.target_rad", item["target_rad"], -3.14, 3.14, n),
                duration_s=toml.number(f"{key}.duration_s", item["duration_s"], SHORTEST_MOVE_S, LONGEST_MOVE_S, n),
                dwell_s=toml.number(f"{key}.dwell_s", item.get("dwell_s", 0.0), 0.0, LONGEST_RUN_S, n),
            )
        )
    return tuple(segments)


def _load_steps(toml: TomlFile) -> tuple[LoadStep, ...]:
    items = toml.data.get("load", [{"time_s": 0.0, "load_kg": 0.0}])
    if not isinstance(items, list) or not items:
        raise toml.error("load", "a list of tables [[load]] with time_s and load_kg is needed")
    steps = []
    for n, item in enumerate(items):
        if not isinstance(item, dict) or set(item) != {"time_s", "load_kg"}:
            raise toml.error("load", "each step needs time_s and load_kg, and nothing else", n)
        steps.append(
            LoadStep(
                toml.number("load.time_s", item["time_s"], 0.0, LONGEST_RUN_S, n),
                toml.number("load.load_kg", item["load_kg"], 0.0, HEAVIEST_KG, n),
            )
        )
    if steps[0].time_s != 0.0 or any(a.time_s >= b.time_s for a, b in itertools.pairwise(steps)):
        raise toml.error("load", "the first step must be at time_s = 0, the others in order of time")
    return tuple(steps)


def with_load(scenario: Scenario, load_kg: float) -> Scenario:
    """The scenario with one constant load."""
    return replace(scenario, load=(LoadStep(0.0, float(load_kg)),))


def check_scenario(scenario: Scenario, machine: Machine) -> None:
    """Check what only machine and run can tell: targets in the joint range, loads the ECU can know, faults in the run.

    Raises
    ------
    ConfigError
        Naming the value and its range.
    """
    for joint, name in enumerate(JOINT_NAMES):
        low, high = machine[f"{name}.q_min_rad"], machine[f"{name}.q_max_rad"]
        poses = [("start_pose_rad", 0, scenario.start_pose_rad[joint])]
        poses += [(f"{name}.segment.target_rad", n, s.target_rad) for n, s in enumerate(scenario.segments[joint])]
        for key, item, pose in poses:
            if not low <= pose <= high:
                what = f"{pose:g} rad is outside the range of the {name}, {low:g} to {high:g} rad"
                raise scenario.source.error(key, what, item) if scenario.source else ConfigError(what)
    highest = machine["estimator.prior.m_t_kg.high"]
    for step in scenario.load:
        if not 0.0 <= step.load_kg <= highest:
            raise ConfigError(
                f"a load of {step.load_kg:g} kg is outside 0 to {highest:g} kg, "
                f"the range of {machine.name} (estimator.prior.m_t_kg.high)"
            )
    if (outside := outside_run(scenario.faults, scenario.duration_s)) is not None:
        n, what = outside
        raise scenario.source.error("faults.start_s", what, n) if scenario.source else ConfigError(what)


def moves(scenario: Scenario) -> list[tuple[float, int, Segment]]:
    """Every move that starts within the run: its time, its joint, its segment; in order of time."""
    found: list[tuple[float, int, Segment]] = []
    for joint, segments in enumerate(scenario.segments):
        time_s = 0.0
        while segments and time_s < scenario.duration_s:
            for segment in segments:
                if time_s < scenario.duration_s:
                    found.append((time_s, joint, segment))
                time_s += segment.duration_s + segment.dwell_s
            if not scenario.repeat:
                break
    return sorted(found, key=lambda move: (move[0], move[1]))


@dataclass(frozen=True)
class Profile:
    """How kind the plant is: what ECU and plant share, and what the plant alone has."""

    name: str
    tare: bool
    machine: dict[str, float] = field(default_factory=dict)
    effects: dict[str, float] = field(default_factory=dict)


PROFILES = ROOT / "sil_plant" / "profiles"
PROFILE_NAMES = ("paper", "realistic")


def load_profile(name: str) -> Profile:
    """Read a profile by its name.

    Raises
    ------
    ConfigError
        Naming file, line and key.
    """
    toml = TomlFile(PROFILES / f"{name}.toml")
    data = toml.data
    for key in data:
        if key not in {"name", "tare", "machine", "effects"}:
            raise toml.error(key, "is not a key of a profile")
    return Profile(
        name=name,
        tare=bool(data.get("tare", False)),
        machine={k: toml.number(f"machine.{k}", v, -1e12, 1e12) for k, v in flatten(data.get("machine", {}))},
        effects={
            f"effects.{k}": toml.number(f"effects.{k}", v, -1e12, 1e12) for k, v in flatten(data.get("effects", {}))
        },
    )
