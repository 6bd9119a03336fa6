"""Somebody else's plant in the place of ours: a co-simulation FMU behind our I/O node, through FMPy.

Only the continuous plant is replaced. Sampling, quantisation, frames, the delay of the valve command within the
tick and the valves' timeout stay the node's: from SYNC the FMU goes on with the old set-points up to the delay, then
with the new ones to the next SYNC.
"""

from __future__ import annotations

import math
import shutil
import tempfile
import zipfile
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from sil_plant.config import ConfigError
from sil_plant.inputs.scenario import Scenario
from sil_plant.loop import io_node
from sil_plant.loop.fmu_map import CHAMBERS, JOINTS, STATE_KEYS, PlantMap, Signal, bind, load_map
from sil_plant.loop.io_node import NodeErrors, NodeTiming
from sil_plant.loop.session import SYNC_COUNTERS, TICK, Session, load_due, on_sync_plain
from sil_plant.plant.dynamics import STATES, XV

FMI_VERSIONS = ("2.0", "3.0")
START_WITHIN_RAD = 0.01  # of the pose that was asked for
_MESSAGES_KEPT = 5


class PlantLostError(Exception):
    """The FMU failed in the middle of a run; says what it said."""


class ExternalPlant:
    """A plant in an FMU.

    Parameters
    ----------
    fmu : Path
        The FMU.
    map_path : Path
        Which of its variables is which signal.

    Raises
    ------
    ConfigError
        When the FMU cannot be used here, or does not fit the map.
    """

    def __init__(self, fmu: Path, map_path: Path) -> None:
        self.path = fmu
        self.map: PlantMap = load_map(map_path)
        self.model = _describe(fmu)
        self.signals = bind(self.map, self.model, fmu)
        self._folder: str | None = None
        self._fmu: Any = None
        self._said: list[str] = []
        self._periods = 0
        self._step_s: float | None = None
        self._load_written: float | None = None
        self._spool = np.zeros(2)
        self._absent = [
            n for n, key in enumerate(STATE_KEYS) if key not in self.signals and not key.startswith("spools")
        ]
        order = [key for key in (*STATE_KEYS, "load.output") if key in self.signals]
        self._outputs = [(key, self.signals[key]) for key in order]

    # ---- before the run ----

    def notes(self, scenario: Scenario, plant_is_kind: bool) -> list[str]:
        """What a user should know about this run, one line each."""
        notes = []
        if "spools.swing" not in self.signals:
            lag = self.map.valve_lag_s
            how = f"the commands behind the map's lag of {lag:g} s" if lag else "the commands themselves"
            notes.append(f"{self.path.name} has no spools: the ECU is told {how}")
        if not any(key.startswith("load.") for key in self.signals) and self.map.load_constant_kg is None:
            notes.append(f"the map does not say what the load of {self.path.name} is: no load error is reported")
        elif "load.input" not in self.signals:
            notes.append(f"the load is that of {self.path.name}; the scenario's and --load do not reach it")
        if not plant_is_kind or scenario.plant:
            notes.append(
                f"changes of the plant by profile or scenario do not reach {self.path.name}; those of sensors, "
                "frames and valve play stay"
            )
        return notes

    def start(self, session: Session, scenario: Scenario) -> None:
        """Instantiate and initialise the FMU, and put its state into the session.

        Raises
        ------
        ConfigError
            When the FMU refuses, with what it said.
        """
        import fmpy
        from fmpy.simulation import apply_start_values, instantiate_fmu

        self._step_s = _communication_step(self.model, session.timing, session.errors, self.path)
        self._folder = tempfile.mkdtemp(prefix="diarc-fmu-")
        node = session.node
        node.count[io_node.EXTERNAL] = 1
        # compiled now, not while a bus waits
        io_node.command_delay(session.timing, session.errors, 0.0)
        io_node.take_command(io_node.make_node(node.y, 0.0), session.timing, session.errors)
        load_due(session, -1)
        try:
            fmpy.extract(str(self.path), unzipdir=self._folder)
            self._fmu = instantiate_fmu(self._folder, self.model, "CoSimulation", logger=self._log, debug_logging=True)
            apply_start_values(self._fmu, self.model, self.map.parameters)
            for joint, angle in zip(JOINTS, scenario.start_pose_rad, strict=True):
                self._write(f"start.{joint}_angle", angle)
            if self.model.fmiVersion == "2.0":
                self._fmu.setupExperiment(startTime=0.0)
                self._fmu.enterInitializationMode()
            else:
                self._fmu.enterInitializationMode(startTime=0.0)
            self._write_inputs(session)
            self._fmu.exitInitializationMode()
            self._read(session, 0.0)
        except Exception as error:
            raise ConfigError(f"{self.path}: cannot be started: {self._reason(error)}") from error
        for i, joint in enumerate(JOINTS):
            pose, told = scenario.start_pose_rad[i], self.signals.get(f"start.{joint}_angle")
            if told is not None and abs(node.y[i] - pose) > START_WITHIN_RAD:
                raise ConfigError(
                    f"{self.path}: {joint} starts at {node.y[i]:g} rad though {told.name} was set to {pose:g}; check "
                    "[start] in the map"
                )

    def __enter__(self) -> ExternalPlant:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Free the FMU and remove what was unpacked."""
        fmu, self._fmu = self._fmu, None
        if fmu is not None:
            for end in (fmu.terminate, fmu.freeInstance):
                try:
                    end()
                except Exception:
                    break  # one that has failed before may refuse
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
            self._folder = None

    # ---- the run ----

    def on_sync(self, session: Session, sync_counter: int, out: np.ndarray) -> int:
        """As :func:`sil_plant.loop.session.on_sync`, with the FMU for a plant."""
        tick, node = int(session.progress.index[TICK]), session.node
        if tick >= session.noise.shape[0]:
            return -1
        load_due(session, tick)
        if self.map.load_constant_kg is not None:
            node.load[0] = self.map.load_constant_kg
        last = int(node.count[io_node.SYNC_LAST])
        for _ in range((sync_counter - last) % SYNC_COUNTERS if last else 0):
            if tick >= session.timeline.parked:
                self.advance_one_period(session, session.noise[tick, 7])
        rows = int(on_sync_plain(session, sync_counter, out))
        session.record.state[tick, self._absent] = np.nan
        if not any(key.startswith("load.") for key in self.signals) and self.map.load_constant_kg is None:
            session.record.load_true[tick] = np.nan
        return rows

    def advance_one_period(self, session: Session, jitter: float) -> None:
        """From one SYNC to the next: the old set-points up to the delay, then the new ones.

        Raises
        ------
        PlantLostError
            When the FMU fails.
        """
        timing, errors = session.timing, session.errors
        delay_s = io_node.command_delay(timing, errors, jitter)
        start_s = self._periods * timing.period_s
        self._advance(session, start_s, delay_s)
        io_node.take_command(session.node, timing, errors)
        self._advance(session, start_s + delay_s, timing.period_s - delay_s)
        self._periods += 1
        try:
            self._read(session, timing.period_s)
        except Exception as error:
            raise PlantLostError(f"{self.path.name} failed: {self._reason(error)}") from error

    def _advance(self, session: Session, time_s: float, duration_s: float) -> None:
        if duration_s <= 0.0:
            return
        pieces = round(duration_s / self._step_s) if self._step_s else 1
        step_s = duration_s / pieces
        try:
            self._write_inputs(session)
            for n in range(pieces):
                answer = self._fmu.doStep(time_s + n * step_s, step_s)
                if answer is not None and answer[1]:
                    raise PlantLostError(f"{self.path.name} ended the simulation at {time_s + n * step_s:g} s")
        except PlantLostError:
            raise
        except Exception as error:
            raise PlantLostError(
                f"{self.path.name} failed in the step of {step_s:g} s from {time_s:g} s: {self._reason(error)}"
            ) from error
        lag_s, u = self.map.valve_lag_s, session.node.u[2]
        self._spool += (u - self._spool) * (1.0 - math.exp(-duration_s / lag_s) if lag_s > 0.0 else 1.0)

    def _write_inputs(self, session: Session) -> None:
        node = session.node
        for i, joint in enumerate(JOINTS):
            self._write(f"commands.{joint}", float(node.u[2, i]))
        if float(node.load[0]) != self._load_written:
            self._load_written = float(node.load[0])
            self._write("load.input", self._load_written)

    def _write(self, key: str, value: float) -> None:
        signal = self.signals.get(key)
        if signal is not None:
            getattr(self._fmu, f"set{signal.type}")([signal.reference], [signal.own(value)])

    def _read(self, session: Session, since_s: float) -> None:
        """Take the FMU's outputs into the node's state; ``since_s`` is how old the state there is."""
        values: dict[str, float] = {}
        for kind in {signal.type for _, signal in self._outputs}:
            group: list[tuple[str, Signal]] = [(key, signal) for key, signal in self._outputs if signal.type == kind]
            numbers = getattr(self._fmu, f"get{kind}")([signal.reference for _, signal in group])
            values |= {key: signal.si(number) for (key, signal), number in zip(group, numbers, strict=True)}
        wrong = [self.signals[key].name for key, value in values.items() if not math.isfinite(value)]
        if wrong:
            raise PlantLostError(f"{', '.join(wrong)}: not a finite number")
        y, before = session.node.y, session.node.y[:2].copy()
        for n, key in enumerate(STATE_KEYS):
            y[n] = values.get(key, 0.0)
        if "rates.swing" not in values and since_s > 0.0:
            y[2:4] = (y[:2] - before) / since_s  # what a jitter of the sampling instant needs; not recorded
        if "spools.swing" not in values:
            y[XV : XV + 2] = self._spool
        if "load.output" in values:
            session.node.load[0] = values["load.output"]

    # ---- what the FMU says ----

    def _log(self, *arguments: Any) -> None:
        """Keep the last messages; FMI 2.0 passes (environment, name, status, category, text), 3.0 no name."""
        text = arguments[-1]
        if isinstance(text, bytes):
            text = text.decode("utf-8", "replace")
        status = arguments[2] if len(arguments) == 5 else arguments[1]
        if status:  # not mere information
            self._said = [*self._said, str(text).strip()][-_MESSAGES_KEPT:]

    def _reason(self, error: Exception) -> str:
        said = "; ".join(self._said)
        return f"{error}" + (f" it says: {said}" if said else "")


def _describe(fmu: Path) -> Any:
    """Model description of an FMU that can be used here."""
    try:
        import fmpy
    except ImportError as error:
        raise ConfigError("FMPy is missing here, without which no FMU runs: make setup") from error
    if not fmu.is_file():
        raise ConfigError(f"{fmu}: cannot be read: there is no such file; check the path")
    try:
        with zipfile.ZipFile(fmu) as archive:
            names = archive.namelist()
            broken = archive.testzip()
    except (zipfile.BadZipFile, OSError, NotImplementedError) as error:
        raise ConfigError(f"{fmu}: is no FMU: {error}; an FMU is a zip file, export it anew") from error
    if broken:
        raise ConfigError(f"{fmu}: is damaged at {broken}; export or copy it anew")
    if "modelDescription.xml" not in names:
        raise ConfigError(f"{fmu}: is no FMU: it has no modelDescription.xml")
    try:
        model = fmpy.read_model_description(str(fmu), validate=False)
    except Exception as error:
        raise ConfigError(f"{fmu}: its modelDescription.xml cannot be read: {error}; export it anew") from error
    version = model.fmiVersion
    if version not in FMI_VERSIONS:
        raise ConfigError(f"{fmu}: is an FMU of FMI {version}; {' and '.join(FMI_VERSIONS)} can be used, export it so")
    if model.coSimulation is None:
        kind = "model exchange" if model.modelExchange is not None else "scheduled execution"
        raise ConfigError(f"{fmu}: is for {kind} only; export it for co-simulation, with its solver")
    ours = fmpy.platform if model.fmiVersion == "2.0" else fmpy.platform_tuple
    suffix = fmpy.sharedLibraryExtension
    if f"binaries/{ours}/{model.coSimulation.modelIdentifier}{suffix}" not in names:
        there = sorted({name.split("/")[1] for name in names if name.startswith("binaries/") and name.count("/") > 1})
        has_code = any(name.startswith("sources/") for name in names)
        text = f"it has {', '.join(there)}" if there else "it has none at all"
        code = f"; it has C code: fmpy compile {fmu}" if has_code else ""
        raise ConfigError(f"{fmu}: has no binary for {ours}: {text}{code or '; export it for this platform'}")
    return model


def _communication_step(model: Any, timing: NodeTiming, errors: NodeErrors, fmu: Path) -> float | None:
    """The one step an FMU takes, or None for any.

    Raises
    ------
    ConfigError
        When the parts of the tick are no multiples of it.
    """
    ability = model.coSimulation
    fixed = ability.fixedInternalStepSize
    if ability.canHandleVariableCommunicationStepSize and fixed is None:
        return None
    parts = [part for part in (timing.delay_s, timing.period_s - timing.delay_s) if part > 0.0]
    experiment = model.defaultExperiment
    step_s = fixed or (experiment.stepSize if experiment is not None else None)
    if step_s is None:
        microseconds = math.gcd(*(round(part * 1e6) for part in parts))
        step_s = microseconds * 1e-6
    step_s = float(step_s)
    if errors.jitter_s > 0.0:
        raise ConfigError(
            f"{fmu}: takes steps of {step_s:g} s only, and the profile's jitter needs any; choose --profile paper"
        )
    for part in parts:
        count = round(part / step_s)
        if count < 1 or abs(count * step_s - part) > 1e-9 * timing.period_s:
            raise ConfigError(
                f"{fmu}: takes steps of {step_s:g} s only; the tick of {timing.period_s:g} s is cut at the valve "
                f"command's delay of {timing.delay_s:g} s, and {part:g} s is no multiple. Export the FMU with a step "
                "that divides both, or change io.command_delay_s of the machine file"
            )
    return step_s


assert len(STATE_KEYS) == STATES and len(CHAMBERS) == 4
