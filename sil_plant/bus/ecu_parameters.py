"""The parameters of an ECU on the bus, by SDO: read, changed, saved. Errors say what to do next."""

from __future__ import annotations

import difflib
import logging
import struct
from collections.abc import Iterator
from contextlib import contextmanager

import canopen

from sil_plant.bus.objects import FIRST_PARAMETER, NODE_ID, parameter_unit
from sil_plant.bus.ports import BusError, connect_python_can
from sil_plant.bus.protocol import database
from sil_plant.inputs.machine import BASE_KEYS, Parameter, ParameterTable, load_parameter_table

IMAGE, LAYOUT_HASH, MODE = 0x2000, 0x2003, 0x2004
STORE, RESTORE = 0x1010, 0x1011
SIGNATURE_SAVE, SIGNATURE_LOAD = b"save", b"load"

ANSWER_LIMIT_S = 1.0
STORE_LIMIT_S = 20.0  # flash and disks take their time
_HEADER = struct.Struct("<4sI4b")

ABORT_STATE, ABORT_NO_MEMORY, ABORT_HARDWARE = 0x08000022, 0x08000020, 0x06060000
ABORT_NO_OBJECT, ABORT_CONTRADICTION = 0x06020000, 0x06040043
ABORT_RANGE = (0x06090030, 0x06090031, 0x06090032)


class RefusedError(Exception):
    """The ECU refused, or what it was to be given is wrong; one line with the next step."""


def find_parameter(name: str) -> tuple[int, Parameter]:
    """A parameter and its number by its name.

    Raises
    ------
    RefusedError
        For an unknown name, with the names that are like it.
    """
    entries = load_parameter_table().entries
    for number, entry in enumerate(entries):
        if entry.name == name:
            return number, entry
    names = [entry.name for entry in entries]
    like = difflib.get_close_matches(name, names, n=3, cutoff=0.6)
    last = name.rsplit(".", 1)[-1]
    like += [other for other in names if last and last in other and other not in like][: 3 - len(like)]
    hint = f"did you mean {' or '.join(like)}?" if like else "`params.py list` has all names"
    raise RefusedError(f"{name}: there is no such parameter; {hint}")


def range_text(entry: Parameter) -> str:
    """Range and unit, for people."""
    unit = parameter_unit(entry)
    return f"{entry.low:g} to {entry.high:g}" + (f" {unit}" if unit else "")


def parse_value(entry: Parameter, text: str) -> float:
    """A number in the parameter's range.

    Raises
    ------
    RefusedError
        With the range.
    """
    try:
        value = float(text)
    except ValueError:
        raise RefusedError(f"{entry.name}: {text!r} is no number; its range is {range_text(entry)}") from None
    if not entry.low <= value <= entry.high:
        raise RefusedError(f"{entry.name}: {text} is outside its range, {range_text(entry)}")
    return value


def image_values(image: bytes) -> dict[str, float]:
    """Bases and parameters of an image by name, in its order; numbers are as binary32 holds them."""
    table = load_parameter_table()
    numbers = struct.unpack_from(f"<{len(table.entries)}f", image, _HEADER.size)
    bases = _HEADER.unpack_from(image)[2:5]
    return {f"base.{key}": float(value) for key, value in zip(BASE_KEYS, bases, strict=True)} | {
        entry.name: number for entry, number in zip(table.entries, numbers, strict=True)
    }


class EcuParameters:
    """An ECU that answers SDO requests; made by `connect`.

    Parameters
    ----------
    sdo : canopen.sdo.SdoClient
        Of the ECU's node.
    bus : str
        For messages.
    """

    def __init__(self, sdo: canopen.sdo.SdoClient, bus: str) -> None:
        self._sdo = sdo
        self._bus = bus
        self._table: ParameterTable = load_parameter_table()
        sdo.RESPONSE_TIMEOUT = ANSWER_LIMIT_S
        heard = int.from_bytes(self._upload(LAYOUT_HASH, 0), "little")
        if heard != self._table.layout_hash:
            raise BusError(
                f"the ECU on {bus} has another list of parameters ({heard:08X}, here it is "
                f"{self._table.layout_hash:08X}): use the params.py of its release, or load this one's firmware"
            )

    def image(self) -> bytes:
        """All parameters in use, as one image."""
        image = self._upload(IMAGE, 0)
        expected = _HEADER.size + 4 * len(self._table.entries) + 4
        if len(image) != expected:
            raise BusError(f"the ECU on {self._bus} sent an image of {len(image)} bytes, not {expected}; try again")
        return image

    def load(self, image: bytes) -> None:
        """Put a whole image into use, or nothing of it."""
        self._download(IMAGE, 0, image, "the set")

    def get(self, name: str) -> float:
        """One parameter, SI."""
        number, _ = find_parameter(name)
        return float(struct.unpack("<f", self._upload(FIRST_PARAMETER + number, 0))[0])

    def set(self, name: str, value: float) -> None:
        """Change one parameter, until power-off."""
        number, entry = find_parameter(name)
        self._download(FIRST_PARAMETER + number, 0, struct.pack("<f", value), f"{name} = {value:g}", entry)

    def change(self, values: dict[str, float]) -> None:
        """Change several parameters, or none of them, until power-off."""
        before = self.image()
        try:
            for name, value in values.items():
                self.set(name, value)
        except RefusedError:
            self.load(before)
            raise

    def save(self) -> None:
        """Keep what is in use over power-off."""
        self._sdo.RESPONSE_TIMEOUT = STORE_LIMIT_S
        self._download(STORE, 1, SIGNATURE_SAVE, "saving")

    def restore(self) -> None:
        """From the next start on, use what is built in."""
        self._sdo.RESPONSE_TIMEOUT = STORE_LIMIT_S
        self._download(RESTORE, 1, SIGNATURE_LOAD, "restoring the default")

    def mode(self) -> str:
        """Name of the mode the ECU is in."""
        number = self._upload(MODE, 0)[0]
        choices = database().get_message_by_name("VALVES").get_signal_by_name("Mode").choices or {}
        return str(choices.get(number, number))

    def _upload(self, index: int, sub: int) -> bytes:
        with self._said(f"reading {index:04X}h"):
            return bytes(self._sdo.upload(index, sub))

    def _download(self, index: int, sub: int, data: bytes, what: str, entry: Parameter | None = None) -> None:
        with self._said(what, entry):
            self._sdo.download(index, sub, data)

    @contextmanager
    def _said(self, what: str, entry: Parameter | None = None) -> Iterator[None]:
        """Errors of SDO and bus, in words."""
        try:
            yield
        except canopen.SdoAbortedError as error:
            raise RefusedError(f"refused: {what}: {self._reason(error, entry)}") from error
        except canopen.SdoCommunicationError as error:
            raise BusError(
                f"no ECU answers on {self._bus} (node {NODE_ID}, {what}); is it running on this bus? "
                f"Start it: ./firmware/diarc_ecu {self._bus}"
            ) from error

    def _reason(self, error: canopen.SdoAbortedError, entry: Parameter | None) -> str:
        if error.code == ABORT_STATE:
            return (
                f"the ECU is in mode {self.mode()}, in which the machine may move; bring it to STANDBY (end the run, "
                "or MOTION.Request STANDBY), then repeat this"
            )
        if error.code in ABORT_RANGE:
            if entry is not None and error.code != ABORT_RANGE[0]:
                return f"the firmware's range is {range_text(entry)}"
            return "a number is outside what this firmware or its number type holds with these bases"
        if error.code == ABORT_CONTRADICTION:
            return (
                "it contradicts another parameter (ends of a range, rod and bore, crank and joint range, observer and "
                "period); change them in another order, or all at once: params.py load MACHINE.toml"
            )
        if error.code == ABORT_NO_MEMORY:
            return "the ECU has no memory to keep parameters in; on Linux start it with --store FILE"
        if error.code == ABORT_HARDWARE:
            return (
                "the ECU's memory failed, what was saved before is still there; on Linux look at disk and --store FILE"
            )
        if error.code == ABORT_NO_OBJECT:
            return "the ECU does not know this object; is its firmware of this release?"
        return str(error)


@contextmanager
def connect(bus: str) -> Iterator[EcuParameters]:
    """An ECU's parameters, while the context lasts.

    Parameters
    ----------
    bus : str
        ``vcan0``, ``tcp:127.0.0.1:29536``, ..

    Raises
    ------
    BusError
        No bus, no ECU, or an ECU of another release.
    """
    logging.getLogger("canopen").setLevel(logging.CRITICAL)  # what it says is said better above
    python_can = connect_python_can(bus)
    python_can.set_filters([{"can_id": 0x580 + NODE_ID, "can_mask": 0x7FF, "extended": False}])
    network = canopen.Network(python_can)
    network.NOTIFIER_CYCLE = 0.05  # s that its thread sleeps at a time; leaving waits for it
    try:
        network.connect()
        node = network.add_node(NODE_ID, canopen.ObjectDictionary())
        yield EcuParameters(node.sdo, bus)
    finally:
        network.disconnect()
