"""What this computer says about a CAN interface and about running in real time; nothing is changed."""

from __future__ import annotations

import errno
import json
import os
import resource
import shutil
import socket
import struct
import subprocess
from dataclasses import dataclass
from pathlib import Path

from sil_plant.config import ROOT

ECU_BINARY = ROOT / "firmware" / "diarc_ecu"
INTERFACES = Path("/sys/class/net")
_ARPHRD_CAN, _IFF_UP = 280, 1
_CAP_IPC_LOCK, _CAP_SYS_NICE = 14, 23
_LOCKED_LEAST_BYTES = 64 << 20  # an ECU process with its libraries needs less
_IP_LIMIT_S = 5.0


@dataclass(frozen=True)
class LinkFacts:
    """A network interface.

    Attributes
    ----------
    name : str
        As asked for.
    exists, is_can, up : bool
        Whether it is there, a CAN interface, and set up.
    virtual : bool
        vcan or vxcan: no bit rate, no cable.
    bitrate : int or None
        Bit/s; None: virtual, not set, or not told (no ``ip`` here).
    state : str or None
        Of the controller: ``ERROR-ACTIVE``, ``ERROR-WARNING``, ``ERROR-PASSIVE``, ``BUS-OFF``, ``STOPPED``.
    restart_ms : int or None
        Time after which a controller leaves bus-off by itself; 0: never.
    queue : int or None
        Frames the transmit queue holds.
    dropped : int
        Frames the kernel dropped, both directions, since the interface is up.
    others : tuple of str
        All CAN interfaces of this computer.
    """

    name: str
    exists: bool
    is_can: bool
    up: bool
    virtual: bool
    bitrate: int | None
    state: str | None
    restart_ms: int | None
    queue: int | None
    dropped: int
    others: tuple[str, ...]


@dataclass(frozen=True)
class RealtimeFacts:
    """Whether diarc_ecu may ask for what ``--pace strict`` needs.

    Attributes
    ----------
    built : bool
        The program is there.
    may_have_priority, may_lock_memory : bool
        SCHED_FIFO and locked memory, by limit, capability of the file, or root.
    """

    built: bool
    may_have_priority: bool
    may_lock_memory: bool


def kernel_has_can() -> bool:
    """Whether this kernel knows CAN sockets."""
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except (OSError, AttributeError):
        return False
    return True


def _read(path: Path) -> str | None:
    try:
        return path.read_text(encoding="ascii").strip()
    except OSError:
        return None


def can_interfaces(root: Path = INTERFACES) -> tuple[str, ...]:
    """Names of the CAN interfaces."""
    try:
        names = sorted(path.name for path in root.iterdir())
    except OSError:
        return ()
    return tuple(name for name in names if _read(root / name / "type") == str(_ARPHRD_CAN))


def link_facts(name: str, root: Path = INTERFACES) -> LinkFacts:
    """Look at a network interface: /sys first, `ip` for what only it tells."""
    place = root / name
    flags = _read(place / "flags")
    details = _ip_details(name) if flags is not None and root == INTERFACES else {}
    info = details.get("linkinfo", {})
    data = info.get("info_data", {})
    queue = _read(place / "tx_queue_len")
    dropped = [_read(place / "statistics" / f"{way}_dropped") for way in ("rx", "tx")]
    return LinkFacts(
        name=name,
        exists=flags is not None,
        is_can=_read(place / "type") == str(_ARPHRD_CAN),
        up=flags is not None and bool(int(flags, 16) & _IFF_UP),
        virtual=info.get("info_kind", "").startswith(("vcan", "vxcan")) or name.startswith(("vcan", "vxcan")),
        bitrate=data.get("bittiming", {}).get("bitrate"),
        state=data.get("state"),
        restart_ms=data.get("restart_ms"),
        queue=None if queue is None else int(queue),
        dropped=sum(int(text) for text in dropped if text),
        others=can_interfaces(root),
    )


def _ip_details(name: str) -> dict:
    """What ``ip -json -details link show NAME`` says; nothing where there is no `ip`, or an old one."""
    ip = shutil.which("ip", path=f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin")
    if ip is None:
        return {}
    try:
        done = subprocess.run(
            [ip, "-json", "-details", "link", "show", name],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=_IP_LIMIT_S,
            check=False,
        )
        found = json.loads(done.stdout or "[]")
    except (OSError, ValueError, subprocess.TimeoutExpired):
        return {}
    return found[0] if found and isinstance(found[0], dict) else {}


def realtime_facts(binary: Path = ECU_BINARY) -> RealtimeFacts:
    """Look at limits, capabilities and user."""
    granted = _capabilities(binary)
    root = os.geteuid() == 0
    priority = resource.getrlimit(resource.RLIMIT_RTPRIO)[0] != 0
    locked = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    enough = locked == resource.RLIM_INFINITY or locked >= _LOCKED_LEAST_BYTES
    return RealtimeFacts(
        built=binary.exists(),
        may_have_priority=root or priority or bool(granted >> _CAP_SYS_NICE & 1),
        may_lock_memory=root or enough or bool(granted >> _CAP_IPC_LOCK & 1),
    )


def _capabilities(path: Path) -> int:
    """The permitted capabilities of a file, one bit each (struct vfs_cap_data of the kernel)."""
    try:
        data = os.getxattr(path, "security.capability")
        _, low, _ = struct.unpack_from("<III", data)
    except OSError as error:
        if error.errno not in (errno.ENODATA, errno.ENOENT, errno.ENOTSUP, errno.EPERM, errno.EACCES):
            raise
        return 0
    except struct.error:
        return 0
    return int(low)
