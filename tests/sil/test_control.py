"""The channel into a running plant: what would make a run another one, or leave who asks without an answer."""

from __future__ import annotations

import contextlib
import json
import socket
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from sil_plant.bus import frames, protocol
from sil_plant.bus.ports import BusError
from sil_plant.inputs.scenario import load_scenario, with_load
from sil_plant.live.plant import LIVE_SCENARIO, PlantLink
from sil_plant.loop import inproc, session
from sil_plant.loop.control_channel import Control, Hello

LIMIT_S = 10.0
HEAVIEST_KG = 15.0
HELLO = Hello("tcp:127.0.0.1:1", "arm.toml", HEAVIEST_KG, False)


@dataclass
class Rig:
    """An arm at rest and its ECU in this process, and a client of its channel."""

    session: session.Session
    ecu: inproc.InprocEcu
    control: Control
    client: socket.socket
    received: bytes = b""

    def tick(self, ticks: int = 1) -> None:
        out = np.zeros((session.OUT_ROWS, frames.FRAME_BYTES), dtype=np.uint8)
        for _ in range(ticks):
            rows = 0
            for row in self.ecu.tick_begin():
                if frames.frame_id(row) == protocol.SYNC_ID:
                    rows = session.on_sync(self.session, int(row[frames.DATA]), out)
                    if rows < 0:
                        self.control.rewound(session.rewind(self.session))
                        rows = session.on_sync(self.session, int(row[frames.DATA]), out)
            for row in self.ecu.tick_end(out[:rows]):
                session.on_frame(self.session, row)

    @property
    def now(self) -> int:
        return int(self.session.progress.index[session.TICK])

    def answer(self) -> dict[str, Any]:
        while b"\n" not in self.received:
            data = self.client.recv(1 << 16)
            assert data, "the plant has hung up"
            self.received += data
        line, _, self.received = self.received.partition(b"\n")
        return json.loads(line)

    def ask(self, request: Any) -> dict[str, Any]:
        text = request if isinstance(request, bytes) else json.dumps(request).encode()
        self.client.sendall(text + b"\n")
        for _ in range(1000):
            self.session = self.control.serve(self.session)
            self.client.settimeout(0.01)
            try:
                return self.answer()
            except TimeoutError:
                continue
            finally:
                self.client.settimeout(LIMIT_S)
        pytest.fail(f"no answer to {request}")


@pytest.fixture
def rig(machine, image) -> Iterator[Rig]:
    """A rig whose arm is in RUN."""
    made = session.make_session(machine, with_load(load_scenario(LIVE_SCENARIO), 2.5), "diarc", 1, 1e-3)
    made = made._replace(noise=made.noise[:1200])
    with Control(0, HELLO) as control, socket.create_connection(("127.0.0.1", control.port), LIMIT_S) as client:
        found = Rig(made, inproc.InprocEcu(image), control, client)
        found.tick(150)
        assert found.session.monitor.whole[session.MODE] == session.MODE_RUN
        found.session = control.serve(found.session)
        assert found.answer()["heaviest_kg"] == HEAVIEST_KG
        yield found


def test_a_load_asked_for_hangs_from_the_tick_that_was_told(rig):
    before = rig.now
    answer = rig.ask({"do": "load", "kg": 4.0})
    rig.tick(5)
    assert answer["ok"] and answer["tick"] == before
    loads = rig.session.record.load_true[before - 1 : before + 4]
    assert loads.tolist() == [2.5, 4.0, 4.0, 4.0, 4.0]
    assert rig.ask({"do": "truth"})["load_kg"] == 4.0
    assert [(c.what, c.time_s) for c in rig.control.commands] == [("load 4 kg", pytest.approx((before - 100) * 1e-3))]


def test_a_fault_asked_for_strikes_at_once_and_ends_and_leaves_those_before_as_they_are(rig):
    tick = rig.now
    assert rig.ask({"do": "fault", "kind": "load_dropped", "size": 1.0, "duration_s": 0.02})["ok"]
    rig.tick(10)
    assert rig.ask({"do": "fault", "kind": "dropped", "target": "encoders", "duration_s": 0.05})["ok"]
    rig.tick(40)
    loads = rig.session.record.load_true[tick : tick + 30]
    assert np.array_equal(loads[:20], np.full(20, 1.0)) and np.array_equal(loads[20:], np.full(10, 2.5))
    assert rig.session.monitor.whole[session.MODE] in (session.MODE_FAULT, 6), "no frames for 40 ticks, and no stop"


@pytest.mark.parametrize(
    ("request_", "word"),
    [
        ({"do": "load"}, "kg"),
        ({"do": "load", "kg": 16.0}, "0 to 15"),
        ({"do": "load", "kg": "5"}, "0 to 15"),
        ({"do": "load", "kg": float("nan")}, "0 to 15"),
        ({"do": "fault", "kind": "nonsense", "duration_s": 1.0}, "known are"),
        ({"do": "fault", "kind": "biased", "target": "swing_angle", "duration_s": 1.0}, "size is missing"),
        ({"do": "fault", "kind": "stuck", "target": "swing_angle", "duration_s": -1.0}, "duration_s"),
        ({"do": "fault", "kind": "send_queue_full", "duration_s": 1.0}, "inproc"),
        ({"do": "fault", "kind": "ecu_killed", "duration_s": 1.0}, "spawn"),
        ({"do": "dance"}, "load, fault and truth"),
        ([1, 2], "object"),
        (b"{", "Expecting"),
        (b"[" * 3000, ""),
    ],
)
def test_nonsense_is_refused_in_words_and_changes_nothing(rig, request_, word):
    before = rig.session
    answer = rig.ask(request_)
    assert not answer["ok"] and word in answer["why"]
    assert rig.session is before and rig.session.node.load[0] == 2.5 and not rig.control.commands
    assert rig.ask({"do": "truth"})["ok"], "the next one is not heard"


def test_a_client_that_talks_without_end_or_never_reads_is_dropped(rig):
    rig.client.sendall(b"x" * 20_000)
    for _ in range(200):
        rig.session = rig.control.serve(rig.session)
    rig.client.settimeout(LIMIT_S)
    with contextlib.suppress(ConnectionResetError):
        assert rig.client.recv(1 << 16) == b"", "the plant listens on"


def test_an_endless_run_goes_on_where_it_was_and_its_faults_end_in_time(rig):
    rig.tick(1150 - rig.now)
    assert rig.ask({"do": "fault", "kind": "load_dropped", "size": 0.5, "duration_s": 0.1})["ok"]
    state = rig.session.node.y.copy()
    rig.tick(60)
    assert rig.now < 200, "no rewinding"
    assert np.abs(rig.session.node.y[:2] - state[:2]).max() < 0.05
    assert rig.ask({"do": "truth"})["load_kg"] == 0.5
    rig.tick(60)
    truth = rig.ask({"do": "truth"})
    assert truth["load_kg"] == 2.5 and truth["time_s"] == pytest.approx((1150 + 120 - 100) * 1e-3)
    assert rig.session.monitor.whole[session.MODE] == session.MODE_RUN


def test_a_port_that_is_taken_is_named():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(BusError, match=f"--control {port}.*choose another"):
            Control(port, HELLO)


def test_a_plant_on_another_bus_is_not_the_one_to_act_on(rig):
    for bus, found in (("vcan0", False), (HELLO.bus, True)):
        link = PlantLink(rig.control.port, bus)
        for _ in range(100):
            link.step()
            rig.session = rig.control.serve(rig.session)
            if link.truth().load_kg is not None or "another bus" in link.reason:
                break
        assert (link.hello is not None) is found, link.reason
        assert (link.truth().load_kg == 2.5) is found
        link.close()


def test_offering_the_channel_does_not_change_a_run(run_py, tmp_path):
    facts = []
    for n, options in enumerate(([], ["--control", "0"])):
        path = tmp_path / f"{n}.json"
        done = run_py(
            "--bus", "tcp:127.0.0.1:0", "--ecu", "spawn", "--pace", "lockstep", "--duration", "0.4", "--load", "2",
            "--json", path, "--quiet", *options, timeout_s=110.0,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        facts.append(json.loads(path.read_text()))
    assert facts[0]["trace_sha256"] == facts[1]["trace_sha256"]
    assert "commands" not in facts[0] and facts[1]["commands"] == []


def test_options_that_cannot_be_are_refused_with_the_way_out(run_py):
    for options, word in (
        (["--bus", "inproc", "--control"], "--bus vcan0"),
        (["--bus", "inproc", "--endless"], "--bus vcan0"),
        (["--bus", "tcp:127.0.0.1:0", "--endless", "--json", "x.json"], "--duration"),
        (["--bus", "tcp:127.0.0.1:0", "--control", "99999"], "0 to 65535"),
    ):
        done = run_py(*options)
        assert done.returncode == 2 and word in done.stderr and done.stderr.count("\n") == 1
