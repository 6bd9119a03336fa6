"""The live page in a browser without a window: a still picture, an estimate of its own, what outlives it."""

from __future__ import annotations

import importlib.util
import io
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from sil_plant.bus import hub
from sil_plant.bus.ports import parse_bus
from sil_plant.config import ConfigError
from sil_plant.inputs.faults import KINDS, read_fault
from sil_plant.loop.control_channel import Request
from sil_plant.monitoring.listen import Listener
from sil_plant.monitoring.watch import Watch
from sil_plant.plant.dynamics import plant_parameters
from sil_plant.plant.geometry import ball_radius_m, geometry

ROOT = Path(__file__).resolve().parents[2]
LIVE = ROOT / "tools" / "live.py"
LIMIT_S = 40.0  # no wait in this file is longer; reaching it is a failure
COMPILE_LIMIT_S = 100.0  # of the first plant on this computer
CANVAS = {"x": 330, "y": 60, "width": 300, "height": 560}  # of the page, between the panels
NUMBER = re.compile(r"-?[0-9]+\.[0-9]+")

viser = pytest.importorskip("viser", reason="PyPI viser is not here: make setup")


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def until(wanted: Callable[[], Any], what: str, limit_s: float = LIMIT_S) -> Any:
    """Look again and again; what was wanted."""
    end = time.monotonic() + limit_s
    while time.monotonic() < end:
        found = wanted()
        if found:
            return found
        time.sleep(0.05)
    pytest.fail(f"not within {limit_s:g} s: {what}")


# ---- geometry ------------------------------------------------------------------------------------


def test_the_cylinders_drawn_are_as_long_as_the_plants(machine):
    plant, shape = plant_parameters(machine), geometry(machine)
    for joint in range(2):
        for angle in np.linspace(*shape.range_rad[joint], 7):
            length = np.sqrt(plant.crank_a2_b2[joint] - 2.0 * plant.crank_ab[joint] * np.cos(angle + plant.q0[joint]))
            drawn = shape.cylinders[joint]
            assert drawn.length_m(angle) == pytest.approx(length, abs=1e-9)
            # the rod ends inside the barrel, and does not come out at its back
            assert 0.0 <= drawn.length_m(angle) - drawn.rod_m <= drawn.barrel_m


def test_the_tip_goes_up_with_the_wrist_and_left_with_the_swing(machine):
    shape = geometry(machine)
    rest = shape.tip((0.0, 0.0))
    assert rest == pytest.approx([sum(shape.links_m), 0.0, shape.base_m])
    assert shape.tip((0.0, 0.5))[2] > rest[2] and shape.tip((0.5, 0.0))[1] > rest[1]


def test_a_ball_has_the_mass_it_is_drawn_for():
    assert 7850.0 * 4.0 / 3.0 * np.pi * ball_radius_m(2.5) ** 3 == pytest.approx(2.5)
    assert ball_radius_m(-0.1) == 0.0


# ---- what the command line says ------------------------------------------------------------------


@pytest.fixture
def live() -> ModuleType:
    """tools/live.py as a module."""
    spec = importlib.util.spec_from_file_location("live", LIVE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_without_viser_the_way_to_get_it_is_named(live, monkeypatch, capsys):
    monkeypatch.setattr(live, "find_spec", lambda name: None)
    assert live.main(["--no-open"]) == 2
    said = capsys.readouterr().err
    assert "viser" in said and ".[live]" in said and "make setup" in said and said.count("\n") == 1


@pytest.mark.parametrize(
    ("options", "word"),
    [
        (["--port", "0"], "1 to 65535"),
        (["inproc"], "inproc"),
        (["nonsense:1"], "not understood"),
        (["vcan0", "--load", "3"], "page"),
        (["--screenshot", "x.txt"], ".png"),
        (["--arm", "nowhere.toml"], "nowhere.toml"),
    ],
)
def test_a_command_line_that_cannot_be_is_refused_in_one_line(live, options, word, capsys):
    try:
        status = live.main([*options, "--no-open", *([] if "--port" in options else ["--port", str(free_port())])])
    except SystemExit as end:
        status = end.code
    said = capsys.readouterr().err
    assert status == 2 and word in said and said.count("\n") == 1


def test_a_port_that_is_taken_is_said_and_nothing_is_started(live, monkeypatch, capsys):
    monkeypatch.setattr(live, "OwnPlant", lambda *_: pytest.fail("a plant was started"))
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert live.main(["--no-open", "--port", str(port)]) == 2
    assert f"port {port}" in (said := capsys.readouterr().err) and f"--port {port % 65535 + 1}" in said


# ---- joining a bus -------------------------------------------------------------------------------


def test_the_page_shows_a_bus_that_comes_and_goes_and_why_the_plant_cannot_be_touched(live, monkeypatch, start_ecu):
    bus_port, page_port = free_port(), free_port()
    bus = f"tcp:127.0.0.1:{bus_port}"
    arguments = live.parse_arguments([bus, "--port", str(page_port), "--no-open", "--control", str(free_port())])
    with ExitStack() as stack:
        tool = live.Live(arguments, stack)
        controls = tool.page.controls
        monkeypatch.setattr(tool.page._server, "get_clients", lambda: {0: None})  # as if somebody looked
        end = time.monotonic() + LIMIT_S

        def shown(text: str) -> Callable[[], bool]:
            def look() -> bool:
                assert time.monotonic() < end, f"never shown: {text}\n{controls._status.content}"
                return text in controls._status.content

            return look

        tool.run(shown("nobody listens"))
        for kind in KINDS:
            if kind != "send_queue_full":
                controls._kind.value = kind
                controls.kind_chosen()
                for target in KINDS[kind].targets or ("-",):
                    controls._victim.value = target
                    controls.victim_chosen()
                    asked = {key: value for key, value in controls._fault().items() if value is not None}
                    read_fault(Request(asked), asked | {"start_s": 0.0}, 0)  # what is offered is not refused
        assert controls._kick.disabled and controls._load.disabled and "--control" in controls._reason.content
        with hub.Hub("127.0.0.1", bus_port) as made:
            going = threading.Event()

            def serve() -> None:
                while not going.is_set():
                    made.receive(0.01)

            thread = threading.Thread(target=serve)
            thread.start()
            try:
                ecu = start_ecu(bus, "--quiet")
                tool.run(shown("PRE_OPERATIONAL"))
                ecu.kill_group()
                tool.run(shown("no frames since"))
            finally:
                going.set()
                thread.join(LIMIT_S)
        tool.run(shown("nobody listens"))


# ---- in a browser --------------------------------------------------------------------------------


@dataclass
class Ears:
    """Every load estimate on the bus, as ``value ± sd`` in the page's digits."""

    bus: str
    heard: list[str] = field(default_factory=list)
    mode: str | None = None
    _going: bool = True

    def __post_init__(self) -> None:
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    def _listen(self) -> None:
        watch = Watch(time.monotonic())
        listener = Listener(parse_bus(self.bus), watch)
        while self._going:
            listener.listen(time.monotonic() + 0.005)
            load = watch.snapshot(now := time.monotonic()).load
            self.mode = watch.snapshot(now).mode
            if load.kg is not None and load.sd_kg is not None:
                self.heard.append(f"{load.kg:.3f} ± {load.sd_kg:.3f} kg")
        listener.close()

    def stop(self) -> None:
        self._going = False
        self._thread.join(LIMIT_S)


@pytest.fixture
def running() -> Iterator[tuple[subprocess.Popen, int]]:
    """tools/live.py with an arm of its own, and its page's port."""
    port = free_port()
    process = subprocess.Popen(
        [sys.executable, str(LIVE), "--port", str(port), "--no-open", "--load", "3.5"],
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    yield process, port
    if process.poll() is None:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(LIMIT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


@pytest.mark.timeout(240)
def test_the_page_opens_the_arm_moves_and_the_estimate_is_the_one_on_the_bus(running):
    pytest.importorskip("playwright", reason="PyPI playwright is not here: make setup")
    from sil_plant.live import picture

    try:
        picture.chromium()
    except ConfigError as error:
        pytest.skip(str(error))
    process, port = running
    first = process.stdout.readline()
    assert f"http://127.0.0.1:{port}" in first, process.stderr.read() if process.poll() is not None else first
    bus = re.search(r"tcp:127\.0\.0\.1:\d+", first).group()
    ears = Ears(bus)
    try:
        with picture.browser_page(1000, 640) as page:
            frames, outside = [], []
            page.on("websocket", lambda socket_: socket_.on("framereceived", lambda data: frames.append(len(data))))
            page.on("request", lambda request: None if "//127.0.0.1:" in request.url else outside.append(request.url))
            page.on("pageerror", lambda error: outside.append(f"error: {error}"))
            page.goto(f"http://127.0.0.1:{port}", timeout=LIMIT_S * 1e3)
            picture.wait_for_estimate(page, int(COMPILE_LIMIT_S * 1e3))

            def text(mark: str) -> str:
                return page.evaluate(f"document.querySelector('[data-diarc=\"{mark}\"]').textContent")

            # the arm moves: what is told of it, what comes to the page, and the picture
            count, before, angle = (
                len(frames),
                pixels(page.screenshot(clip=CANVAS)),
                NUMBER.search(text("swing")).group(),
            )
            page.wait_for_function(
                """from => {
                    const told = document.querySelector('[data-diarc="swing"]').textContent;
                    return Math.abs(parseFloat(told) - from) > 0.15;
                }""",
                arg=float(angle),
                timeout=LIMIT_S * 1e3,
            )
            assert len(frames) > count
            assert changed(before, pixels(page.screenshot(clip=CANVAS))) > 300, "the arm stands still in the picture"

            # the estimate shown is one that was on the bus
            for _ in range(3):
                shown = text("load")
                until(lambda: shown in ears.heard, f"{shown} on the bus; heard {ears.heard[-3:]}")  # noqa: B023
                page.wait_for_timeout(200)

            # a load that somebody hangs on the tip is the true one, and becomes the estimate
            page.get_by_label("load, kg").or_(page.locator("input[value='3.5']")).last.fill("5")
            page.keyboard.press("Enter")
            page.wait_for_function("document.body.innerText.includes('5.000 kg')", timeout=LIMIT_S * 1e3)
            until(lambda: abs(float(NUMBER.search(text("load")).group()) - 5.0) < 0.2, "the estimate follows")

            # a mode that is asked for is the ECU's
            page.get_by_text("HOLD", exact=True).click()
            page.wait_for_function(
                "document.querySelector('[data-diarc=\"mode\"]').textContent === 'HOLD'", timeout=LIMIT_S * 1e3
            )
            until(lambda: ears.mode == "HOLD", "HOLD on the bus")
            assert not outside
        process.send_signal(signal.SIGINT)
        assert process.wait(LIMIT_S) == 0, process.stderr.read()
        assert "Traceback" not in process.stderr.read()
        until(lambda: nobody_listens(int(bus.rpartition(":")[2])), "the plant it has started ends")
    finally:
        ears.stop()


def pixels(png: bytes) -> np.ndarray:
    from PIL import Image

    return np.asarray(Image.open(io.BytesIO(png)).convert("L"), dtype=np.int16)


def changed(before: np.ndarray, after: np.ndarray) -> int:
    """How many pixels differ by more than a flicker."""
    return int((np.abs(after - before) > 40).sum())


def nobody_listens(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) != 0
