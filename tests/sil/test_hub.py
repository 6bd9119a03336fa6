"""The socketcand hub: what would break a run or a user's tool if it came back."""

from __future__ import annotations

import logging
import re
import socket
import threading
import time
from collections.abc import Callable, Iterator

import can
import pytest

from sil_plant.bus import hub as hub_module
from sil_plant.bus.hub import EXTENDED_ID, BusError, Hub

LIMIT_S = 8.0  # no wait in this file is longer; reaching it is a failure

logging.getLogger("can.interfaces.socketcand.socketcand").setLevel(logging.ERROR)


@pytest.fixture
def hub() -> Iterator[Hub]:
    with Hub("127.0.0.1", 0) as hub:
        yield hub


class RawClient:
    """A client made of a bare socket, for text no library would send."""

    def __init__(self, hub: Hub, *, join: bool = True) -> None:
        self.hub = hub
        self.sock = socket.create_connection(("127.0.0.1", hub.port), timeout=LIMIT_S)
        self.sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.sock.setblocking(False)
        self.text = ""
        if join:
            self.expect("< hi >")
            self.say("< open vcan0 >")
            self.expect("< ok >")
            self.say("< rawmode >")
            self.expect("< ok >")

    def say(self, text: str) -> None:
        self.sock.sendall(text.encode("latin-1"))

    def read(self, enough: Callable[[str], bool]) -> str:
        """Serve the hub until the text read so far is `enough`; hands it out and forgets it."""

        def done() -> bool:
            try:
                chunk = self.sock.recv(65536)
                assert chunk, f"the hub closed the connection after {self.text!r}"
                self.text += chunk.decode()
            except BlockingIOError:
                pass
            return enough(self.text)

        serve_until(self.hub, done)
        text, self.text = self.text, ""
        return text

    def expect(self, text: str) -> None:
        assert self.read(lambda got: len(got) >= len(text)) == text

    def frames(self, count: int) -> list[tuple[str, str]]:
        """Id and data, as text, of the next frames."""
        text = self.read(lambda got: got.count(">") >= count)
        found = re.findall(r"< frame ([0-9A-F]+) [0-9]+\.[0-9]{6} ([0-9A-F]*) >", text)
        assert len(found) == text.count(">") == count, text
        return found


def serve_until(hub: Hub, done: Callable[[], bool]) -> None:
    """Drive the hub without taking frames out of its local port."""
    end = time.monotonic() + LIMIT_S
    while not done():
        assert time.monotonic() < end, f"nothing came of it; the hub remarked {list(hub.events)}"
        hub.service()
        time.sleep(0.0002)


def python_can_client(hub: Hub, while_waiting: Callable[[], None] = lambda: None) -> can.BusABC:
    """A real python-can client; its constructor blocks, so it runs in a thread while the hub is served."""
    made: list[can.BusABC] = []
    failed: list[Exception] = []

    def connect() -> None:
        try:
            made.append(can.Bus(interface="socketcand", channel="vcan0", host="127.0.0.1", port=hub.port))
        except Exception as error:
            failed.append(error)

    thread = threading.Thread(target=connect, daemon=True)
    thread.start()

    def done() -> bool:
        while_waiting()
        return not thread.is_alive()

    serve_until(hub, done)
    assert not failed, failed
    return made[0]


def message(can_id: int, data: bytes, extended: bool = False) -> can.Message:
    return can.Message(arbitration_id=can_id, data=data, is_extended_id=extended)


def test_frames_are_neither_lost_nor_reordered_between_python_can_clients(hub: Hub) -> None:
    """GIVEN two python-can clients WHEN one of them and the owner send 10,000 frames each at full speed
    THEN the other client gets all 20,000 and the owner 10,000, each sender's in order."""
    count = 10_000
    sender, listener = python_can_client(hub), python_can_client(hub)
    heard: dict[int, list[int]] = {0x100: [], 0x200: []}

    def speak() -> None:
        for i in range(count):
            sender.send(message(0x100, i.to_bytes(4, "big")))

    def listen() -> None:
        end = time.monotonic() + LIMIT_S
        while sum(map(len, heard.values())) < 2 * count and time.monotonic() < end:
            got = listener.recv(0.1)
            if got is not None:
                heard[got.arbitration_id].append(int.from_bytes(got.data, "big"))

    threads = [threading.Thread(target=work, daemon=True) for work in (speak, listen)]
    for thread in threads:
        thread.start()
    owner_got: list[int] = []
    sent = 0
    end = time.monotonic() + LIMIT_S
    while any(thread.is_alive() for thread in threads) and time.monotonic() < end:
        if sent < count:
            for i in range(sent, sent + 10):
                hub.send(0x200, i.to_bytes(4, "big"))
            sent += 10
        while (frame := hub.receive(0 if sent < count else 0.005)) is not None:
            assert frame[0] == 0x100
            owner_got.append(int.from_bytes(frame[1], "big"))
    while (frame := hub.receive(0)) is not None:
        owner_got.append(int.from_bytes(frame[1], "big"))
    sender.shutdown()
    listener.shutdown()
    assert owner_got == list(range(count))
    assert heard == {0x100: list(range(count)), 0x200: list(range(count))}


def test_tool_that_joins_a_busy_bus_does_not_fail_in_the_handshake(hub: Hub) -> None:
    """GIVEN a bus with constant traffic WHEN python-can clients join, again and again
    THEN no frame is glued to their last < ok >, which they could not parse."""

    def traffic() -> None:
        for i in range(20):
            hub.send(0x182, bytes([i]))
            hub.service()  # often, so that a frame follows the answer before the client's thread wakes up

    for _ in range(20):
        python_can_client(hub, traffic).shutdown()


def test_frames_for_a_new_client_are_kept_until_it_has_read_the_answer(hub: Hub) -> None:
    """GIVEN a client that has not read the answer to < rawmode > WHEN the owner sends 3 frames
    THEN the answer stands alone for as long as it is unread, and the frames follow, all of them."""
    client = RawClient(hub, join=False)
    client.expect("< hi >")
    client.say("< open vcan0 >")
    client.expect("< ok >")
    client.say("< rawmode >")
    serve_until(hub, lambda: hub.clients[0].mode == "raw")
    for i in range(3):
        hub.send(0x100 + i, b"")
        assert hub.receive(0.005) is None
    assert client.sock.recv(256) == b"< ok >"
    assert [can_id for can_id, _ in client.frames(3)] == ["100", "101", "102"]


def test_frames_for_a_new_client_come_without_proc(hub: Hub, monkeypatch: pytest.MonkeyPatch) -> None:
    """GIVEN a system on which nobody can tell whether a peer has read WHEN a frame is sent to a new client
    THEN it comes after a grace time instead of never."""
    monkeypatch.setattr(hub_module, "_unread_by_peer", lambda sock: None)
    client = RawClient(hub)
    hub.send(0x123, b"\x01")
    assert client.frames(1) == [("123", "01")]


def test_each_answer_of_the_handshake_is_its_own_segment(hub: Hub) -> None:
    """GIVEN a new client WHEN it goes through the handshake step by step
    THEN each answer is exactly what python-can and SavvyCAN compare with."""
    client = RawClient(hub, join=False)
    for command, answer in [("", "< hi >"), ("< open any_name >", "< ok >"), ("< rawmode >", "< ok >")]:
        client.say(command)
        client.expect(answer)
    assert hub.clients[0].channel == "any_name"


def test_frames_without_data_survive_in_both_directions(hub: Hub) -> None:
    """GIVEN a python-can client WHEN SYNC-like frames of length 0 go both ways THEN they arrive empty."""
    bus = python_can_client(hub)
    hub.send(0x080, b"")
    bus.send(message(0x081, b""))
    assert hub.receive(LIMIT_S) == (0x081, b"")
    got = bus.recv(LIMIT_S)
    assert got is not None and (got.arbitration_id, got.dlc, bytes(got.data)) == (0x080, 0, b"")
    bus.shutdown()


def test_29_bit_ids_are_not_confused_with_11_bit_ids(hub: Hub) -> None:
    """GIVEN a python-can client WHEN it and the owner send 29-bit ids, also small ones
    THEN they stay 29-bit ids."""
    bus = python_can_client(hub)
    for can_id in (0x18DAF110, 0x123):
        bus.send(message(can_id, b"\x01", extended=True))
        assert hub.receive(LIMIT_S) == (can_id | EXTENDED_ID, b"\x01")
        hub.send(can_id | EXTENDED_ID, b"\x02")
        hub.service()
        got = bus.recv(LIMIT_S)
        assert got is not None and got.is_extended_id and got.arbitration_id == can_id
    bus.shutdown()


def test_every_byte_value_survives_in_every_spelling(hub: Hub) -> None:
    """GIVEN the spellings of python-can (1F, 5), C code (%02X, %02x) and SavvyCAN (sign-extended)
    WHEN each byte value is sent in each of them THEN the owner gets that value."""
    client = RawClient(hub)
    sent = []
    for value in range(256):
        texts = [f"{value:x}", f"{value:02x}", f"{value:02X}"]
        if value >= 0x80:
            texts.append(f"ffffffffffffff{value:02x}")
        client.say("".join(f"< send 7b 1 {text} >" for text in texts))
        sent += [(0x07B, bytes([value]))] * len(texts)
    assert [hub.receive(LIMIT_S) for _ in sent] == sent
    client.say("< send ffffffff98daf110 0 >")  # SavvyCAN's way to say 29 bits
    assert hub.receive(LIMIT_S) == (0x18DAF110 | EXTENDED_ID, b"")
    assert hub.malformed == 0


def test_segments_cut_anywhere_give_the_same_frames(hub: Hub) -> None:
    """GIVEN a text of several commands WHEN it comes byte by byte, or all at once, even with line ends
    THEN the frames are the same."""
    text = "< send 123 2 1 2 >< echo >\r\n < send 456 0 >< send 7FF 8 1 2 3 4 5 6 7 FF >"
    frames = [(0x123, b"\1\2"), (0x456, b""), (0x7FF, b"\1\2\3\4\5\6\7\xff")]
    client, other = RawClient(hub), RawClient(hub)
    for char in text:
        client.say(char)
        hub.service()
    client.say(text)
    assert [hub.receive(LIMIT_S) for _ in range(6)] == frames * 2
    assert other.frames(6) == [("123", "0102"), ("456", ""), ("7FF", "01020304050607FF")] * 2
    assert client.read(lambda got: got.count(">") == 2) == "< echo >< echo >"


def test_handshake_in_one_segment_still_works(hub: Hub) -> None:
    """GIVEN a client that does not wait for answers WHEN it sends all in one segment THEN it takes part."""
    client = RawClient(hub, join=False)
    client.say("< open vcan0 >< rawmode >< send 123 1 AA >")
    assert hub.receive(LIMIT_S) == (0x123, b"\xaa")
    client.expect("< hi >< ok >< ok >")


def test_client_that_never_reads_is_dropped_and_does_not_block_the_others(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """GIVEN one client that reads and one that never does WHEN more frames are sent than can be buffered
    THEN the silent one is disconnected with a message, and the other has all frames."""
    caplog.set_level(logging.WARNING)
    with Hub("127.0.0.1", 0, max_backlog=100_000) as hub:
        reader, sleeper = RawClient(hub), RawClient(hub)
        sleeper.sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        heard = sent = 0
        while hub.dropped_clients == 0:
            assert sent < 1_000_000
            for i in range(100):
                hub.send(0x300, (sent + i).to_bytes(4, "big"))
            sent += 100
            got = reader.frames(100)
            assert [int(data, 16) for _, data in got] == list(range(heard, heard + 100))
            heard += 100
        assert [c.mode for c in hub.clients] == ["raw"]
        assert "does not read" in caplog.text and "does not read" in hub.events[-1]
        reader.say("< send 123 0 >")
        assert hub.receive(LIMIT_S) == (0x123, b"")


def test_client_that_joins_and_never_reads_the_answer_is_dropped_as_well() -> None:
    """GIVEN a client whose frames are held because it does not read the last < ok > WHEN it stays so
    THEN the held frames do not grow beyond the limit."""
    with Hub("127.0.0.1", 0, max_backlog=20_000) as hub:
        client = RawClient(hub, join=False)
        client.say("< open vcan0 >< rawmode >")
        serve_until(hub, lambda: bool(hub.clients) and hub.clients[0].mode == "raw")
        for _ in range(1000):
            hub.send(0x300, bytes(8))
        hub.service()
        assert hub.dropped_clients == 1 and hub.clients == []


@pytest.mark.parametrize("abrupt", [False, True], ids=["closed", "reset"])
def test_client_that_vanishes_in_the_middle_of_a_line_leaves_no_trace(hub: Hub, abrupt: bool) -> None:
    """GIVEN a client that has sent half a frame WHEN it closes or is reset
    THEN the half frame is forgotten, and the others go on."""
    client, other = RawClient(hub), RawClient(hub)
    client.say("< send 123 1 1 >< send 124 8 1 2 3")
    assert hub.receive(LIMIT_S) == (0x123, b"\x01")
    if abrupt:
        client.sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
    client.sock.close()
    for _ in range(3):
        hub.send(0x100, b"")  # also into the closed connection
    serve_until(hub, lambda: len(hub.clients) == 1)
    assert ("gone" if abrupt else "in the middle of a line") in " ".join(hub.events)
    other.say("< send 125 0 >")
    assert hub.receive(LIMIT_S) == (0x125, b"")
    assert other.frames(4)[1:] == [("100", "")] * 3


MALFORMED = [
    "garbage >",
    ">",
    "< >",
    "< send >",
    "< send 123 >",
    "< send 123 2 1 >",  # fewer data than said
    "< send 123 1 1 2 >",  # more
    "< send 123 9 1 2 3 4 5 6 7 8 9 >",
    "< send 123 1 100 >",
    "< send 123 1 G1 >",
    "< send 800 0 >",  # too big for 11 bits
    "< send 3FFFFFFF 0 >",  # too big for 29 bits
    "< send -12 0 >",
    "< send 1_2 0 >",
    "< send 123 2 0102 >",
    "< send 123 < send 124 0 >",
    "< frame 123 1.0 00 >",
    "< fly >",
    "\xff\x00\x01 >",
]


def test_malformed_text_is_answered_counted_and_harmless(hub: Hub) -> None:
    """GIVEN malformed texts WHEN each comes from a client, between two good frames
    THEN each is answered with one < error ... >, counted, and the good frames pass."""
    client, other = RawClient(hub), RawClient(hub)
    for text in MALFORMED:
        client.say(f"< send 001 0 >{text}< send 002 0 >")
        assert [hub.receive(LIMIT_S), hub.receive(LIMIT_S)] == [(1, b""), (2, b"")], text
        answer = client.read(lambda got: ">" in got)
        assert re.fullmatch(r"< error 000 [0-9.]+ cannot understand: [^<>]* >", answer), answer
        assert other.frames(2) == [("001", ""), ("002", "")]
    assert hub.malformed == len(MALFORMED)
    assert sum("not socketcand" in event for event in hub.events) == 1  # the log is not flooded


def test_endless_text_without_an_end_does_not_fill_the_memory(hub: Hub) -> None:
    """GIVEN a client that sends text without '>' WHEN it goes on THEN the text is refused and forgotten."""
    client = RawClient(hub)
    for _ in range(50):
        client.say("< send 123 " + "1 " * 200)
        hub.service()
    client.say(">< send 123 0 >")
    assert hub.receive(LIMIT_S) == (0x123, b"")
    assert hub.malformed >= 1
    assert max(len(c.partial) for c in hub._clients.values()) <= 256


def test_error_answer_does_not_break_a_python_can_client(hub: Hub) -> None:
    """GIVEN a python-can client WHEN it sends what the hub refuses (a remote frame with a length)
    THEN its receive call hands up an error frame instead of raising."""
    bus = python_can_client(hub)
    bus.send(can.Message(arbitration_id=0x123, is_remote_frame=True, is_extended_id=False, dlc=2))
    serve_until(hub, lambda: hub.malformed == 1)
    hub.service()
    got = bus.recv(LIMIT_S)
    assert got is not None and got.is_error_frame
    bus.shutdown()


def test_bcm_commands_and_frames_before_rawmode_are_refused_not_ignored(hub: Hub) -> None:
    """GIVEN a client that expects bcm mode WHEN it uses it THEN it is told so, and no frame passes."""
    client = RawClient(hub, join=False)
    client.expect("< hi >")
    client.say("< rawmode >")
    assert "open a bus first" in client.read(lambda got: ">" in got)
    client.say("< open vcan0 >")
    client.expect("< ok >")
    for text in (
        "< send 123 1 1 >",
        "< subscribe 0 0 123 >",
        "< add 1 0 123 1 1 >",
        "< bcmmode >",
        "< fdsend 123 0 1 1 >",
    ):
        client.say(text)
        answer = client.read(lambda got: ">" in got)
        assert answer.startswith("< error 000 ") and answer.count("<") == 1, answer
    assert hub.receive(0) is None
    assert (hub.refused, hub.malformed) == (6, 0)


def test_one_write_carries_all_frames_of_a_batch(hub: Hub) -> None:
    """GIVEN a client WHEN the owner sends 10 frames and then waits THEN they come with one time stamp,
    and nothing is written before the wait."""
    client = RawClient(hub)
    hub.send(0x100, b"")
    assert len(client.frames(1)) == 1  # the handshake is over
    hub.send_many((0x100 + i, bytes([i])) for i in range(10))
    with pytest.raises(BlockingIOError):
        client.sock.recv(1)
    hub.receive(0)
    text = client.read(lambda got: got.count(">") == 10)
    assert len(set(re.findall(r"[0-9]+\.[0-9]{6}", text))) == 1


def test_owner_that_lags_behind_makes_the_clients_wait_and_loses_nothing(
    hub: Hub, monkeypatch: pytest.MonkeyPatch
) -> None:
    """GIVEN an owner that serves the hub but takes no frames WHEN a client floods it
    THEN reading stops at a limit and goes on later, without a loss."""
    monkeypatch.setattr(hub_module, "_INBOX_LIMIT", 100)
    client = RawClient(hub)
    for i in range(50):
        client.say("".join(f"< send 123 2 {i:x} {j:x} >" for j in range(20)))
        hub.service()
    assert any("frames wait for the owner" in event for event in hub.events)
    expected = [(0x123, bytes([i, j])) for i in range(50) for j in range(20)]
    assert [hub.receive(LIMIT_S) for _ in expected] == expected


def test_discarded_frames_do_not_come_back(hub: Hub) -> None:
    """GIVEN two frames that have come WHEN they are discarded THEN the next one received is a later one."""
    client = RawClient(hub)
    client.say("< send 001 0 >< send 002 0 >")
    serve_until(hub, lambda: hub.frames == 2)
    assert hub.discard_pending() == 2
    client.say("< send 003 0 >")
    assert hub.receive(LIMIT_S) == (3, b"")


def test_last_frames_arrive_although_the_hub_closes_at_once() -> None:
    """GIVEN a client WHEN the owner sends a frame and closes the hub THEN the client has the frame."""
    with Hub("127.0.0.1", 0) as hub:
        client = RawClient(hub)
        hub.send(0x702, b"\x04")
    client.sock.settimeout(LIMIT_S)
    assert b"< frame 702 " in client.sock.recv(256)
    assert client.sock.recv(256) == b""


def test_second_hub_on_the_same_port_right_after_the_first() -> None:
    """GIVEN a hub that closed with a client connected (its port is in TIME_WAIT) WHEN the next one starts on
    that port THEN it works."""
    with Hub("127.0.0.1", 0) as hub:
        client = RawClient(hub)
        port = hub.port
    client.sock.close()
    with Hub("127.0.0.1", port) as hub:
        RawClient(hub).say("< send 123 0 >")
        assert hub.receive(LIMIT_S) == (0x123, b"")


def test_busy_port_is_reported_with_the_next_step(hub: Hub) -> None:
    """GIVEN a port that is taken WHEN a hub wants it THEN one line names it and says what to do."""
    with pytest.raises(BusError) as caught:
        Hub("127.0.0.1", hub.port)
    line = str(caught.value)
    assert f"port {hub.port}" in line and "ss -ltnp" in line and "choose another" in line and "\n" not in line


@pytest.mark.parametrize("host", ["0.0.0.0", "", "192.0.2.1"])
def test_address_others_can_reach_is_refused(host: str) -> None:
    """GIVEN an address that is not loopback WHEN a hub shall listen there THEN it refuses and says why."""
    with pytest.raises(BusError, match=r"refused.*tcp:127\.0\.0\.1"):
        Hub(host, 0)


def test_address_others_can_reach_is_possible_when_asked_for() -> None:
    """GIVEN allow_remote WHEN a hub listens on all addresses THEN it does."""
    with Hub("0.0.0.0", 0, allow_remote=True) as hub:
        assert hub.port > 0


@pytest.mark.parametrize(("can_id", "data"), [(0x100, bytes(9)), (-1, b""), (0x2000_0000, b"")])
def test_impossible_frames_of_the_owner_raise(hub: Hub, can_id: int, data: bytes) -> None:
    """GIVEN 9 bytes or an id that does not exist WHEN the owner sends it THEN it raises."""
    with pytest.raises(ValueError):
        hub.send(can_id, data)


def test_closing_twice_is_harmless() -> None:
    """GIVEN a closed hub WHEN it is closed again THEN nothing happens."""
    hub = Hub("127.0.0.1", 0)
    hub.close()
    hub.close()
