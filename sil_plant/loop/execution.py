"""Carry out a session: with the firmware in this process, or with an ECU on a bus, ours or one that is there."""

from __future__ import annotations

import subprocess
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from sil_plant.bus.ports import BusAddress, BusError, HubPort, open_frame_port
from sil_plant.config import ROOT, ConfigError
from sil_plant.environment import say
from sil_plant.inputs.faults import Fault
from sil_plant.inputs.machine import Machine
from sil_plant.inputs.scenario import Scenario, with_load
from sil_plant.loop import bus_run, inproc, session
from sil_plant.loop.external_plant import ExternalPlant

ECU_BINARY = ROOT / "firmware" / "diarc_ecu"
PERIOD_US = 1000
SPAWN_STOP_S = 5.0
INPROC_CHUNK = 250


class SpawnedEcu:
    """An ECU process of ours.

    Parameters
    ----------
    bus : str
        The bus string it gets.
    pace : str
        Its ``--pace``.
    params : Path
        Its parameter image.
    """

    def __init__(self, bus: str, pace: str, params: Path) -> None:
        if not ECU_BINARY.exists():
            raise ConfigError(f"{ECU_BINARY.relative_to(ROOT)} is not built; build it: make firmware")
        self.command = [str(ECU_BINARY), bus, "--pace", pace, "--quiet", "--params", str(params)]
        self.start()

    def start(self) -> None:
        """Start the process; again after a :meth:`kill`."""
        self.process = subprocess.Popen(self.command, stdin=subprocess.DEVNULL)

    def kill(self) -> None:
        """End the process as a loss of power would."""
        self.process.kill()
        self.process.wait()

    def check(self) -> None:
        """Raise when the process has ended."""
        status = self.process.poll()
        if status is not None:
            raise bus_run.EcuLostError(f"the ECU that was started has ended with status {status}")

    def stop(self) -> None:
        """End the process as its user would, and at last by force."""
        if self.process.poll() is None:
            self.process.terminate()
        try:
            self.process.wait(SPAWN_STOP_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


def compile_plant(machine: Machine, scenario: Scenario) -> None:
    """Run a few ticks in memory, so that no compiling happens while a bus waits.

    Raises
    ------
    ConfigError
        When the firmware is not built or refuses the machine.
    """
    from numba.core import config

    compiled = "on_sync_with_faults" if scenario.faults else "on_sync_plain"
    if not any(Path(config.CACHE_DIR).glob(f"**/session.{compiled}*.nbi")):
        say("compiling the plant, once after installation (up to a minute) ...")
    short = with_load(replace(scenario, duration_s=0.01), 0.0)
    try:
        warm = session.make_session(machine, short, "diarc", 0, PERIOD_US * 1e-6)
    except ValueError as error:
        raise ConfigError(str(error)) from error
    inproc.run_inproc(warm, inproc.InprocEcu(period_us=PERIOD_US), 5)
    bus_run.warm_up(warm)


def in_process(
    run: session.Session,
    image: bytes,
    scalar: str,
    progress: Callable[[int], None],
    plant: ExternalPlant | None = None,
) -> float:
    """Run the session with the firmware in this process; the wall time it took, s."""
    ecu = inproc.InprocEcu(image, PERIOD_US, scalar)
    start = time.perf_counter()
    while inproc.run_inproc(run, ecu, INPROC_CHUNK, plant) == INPROC_CHUNK:
        progress(int(run.progress.index[session.TICK]))
        bus_run.check_hash(run)
    return time.perf_counter() - start


def over_bus(
    run: session.Session,
    address: BusAddress,
    pace: str | None,
    image: bytes,
    progress: Callable[[int], None],
    quiet: bool,
    *,
    plant: ExternalPlant | None = None,
    afterwards: Callable[[str], None] | None = None,
    commands: bus_run.Commands | None = None,
    endless: bool = False,
) -> float:
    """Run the session with an ECU on a bus.

    Parameters
    ----------
    run : Session
        The run.
    address : BusAddress
        The bus; a ``tcp:`` one is hosted here.
    pace : str or None
        Start an ECU of ours at this pace; None uses the one that is there.
    image : bytes
        Parameter image of an ECU of ours.
    progress : callable
        Told the tick now and then.
    quiet : bool
        Say nothing but errors.
    plant : ExternalPlant, optional
        Another plant than ours.
    afterwards : callable or None
        Called with the bus string at the end of a run, with the valves shut and the ECU in PRE-OPERATIONAL: it answers
        SDO.
    commands : Commands or None
        What others may ask of the plant.
    endless : bool
        Go on after the end of the scenario.

    Returns
    -------
    float
        Wall time from the ECU's restart to the end of the run, s.
    """
    with ExitStack() as stack:
        port = stack.enter_context(open_frame_port(address, host_hub=True))
        bus = str(address)
        if isinstance(port, HubPort):
            bus = f"tcp:{address.host}:{port.hub.port}"
            if not quiet and pace is None:
                say(f"CAN over TCP at {bus}; start the ECU: ./firmware/diarc_ecu {bus}")
        alive: Callable[[], None] = _always
        ecu = None
        if pace is not None:
            folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="diarc-"))
            params = Path(folder) / "machine.params"
            params.write_bytes(image)
            ecu = SpawnedEcu(bus, pace, params)
            stack.callback(ecu.stop)
            alive = ecu.check
        stack.callback(bus_run.leave_ecu_safe, port)
        bus_run.wait_for_ecu(port, bus, alive)
        start = time.perf_counter()
        try:
            bus_run.run_on_bus(run, port, progress, alive, ecu, plant, commands, endless)
        except BusError as error:
            bus_run.close_valves(run, plant)
            raise bus_run.EcuLostError(f"{error}; the valves are closed") from error
        wall_s = time.perf_counter() - start
        if afterwards is not None:
            bus_run.park_ecu(port)
            with bus_run.served(port):
                afterwards(bus)
        return wall_s


def _always() -> None:
    """An ECU that is not ours is watched through its frames alone."""


def check_faults(faults: tuple[Fault, ...], in_process: bool, spawned: bool) -> None:
    """Refuse faults that this way of running cannot inject.

    Raises
    ------
    ConfigError
        Saying which way can.
    """
    for fault in faults:
        if fault.kind == "send_queue_full" and not in_process:
            raise ConfigError("send_queue_full is the in-process driver's fault: --bus inproc")
        if fault.kind == "ecu_killed" and not in_process and not spawned:
            raise ConfigError("ecu_killed needs an ECU that run.py may kill: --ecu spawn, or --bus inproc")


def outcome(run: session.Session, mode: int = session.MODE_RUN) -> str | None:
    """What went wrong in a run that reached its end, or None. With faults on purpose, only how it ended counts.

    Parameters
    ----------
    run : Session
        The run.
    mode : int
        The mode the ECU must be in at its end: RUN, or COMMISSION after a commissioning run.
    """
    whole = run.monitor.whole
    on_purpose = len(run.injection.plan) > 0
    if whole[session.FAULTED] and not on_purpose:
        return f"the ECU went to FAULT (code {whole[session.FAULT]}, emergency {whole[session.EMERGENCY]:04X}h)"
    if whole[session.MODE] != mode:
        ended = session.MODE_NAMES.get(int(whole[session.MODE]), "?")
        fault = f", fault {whole[session.FAULT]}, emergency {whole[session.EMERGENCY]:04X}h" if on_purpose else ""
        wanted = session.MODE_NAMES[mode]
        return f"the ECU is in {ended}, not in {wanted} (last refusal {whole[session.LAST_REFUSAL]}{fault})"
    refused = whole[session.REFUSED] - run.progress.index[session.ASKED_AGAIN]
    if refused > 0 and not on_purpose:
        return f"the ECU refused {refused} requests (last reason {whole[session.LAST_REFUSAL]})"
    return None
