"""The software-in-the-loop rig: plant, I/O node, buses and runs.

Importing it tells numba where to keep compiled code: a folder named after the hash of all sources of this package,
because numba itself only notices changes of the file a function stands in, not of those it calls.
"""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

_HERE = Path(__file__).resolve().parent


def _cache_folder() -> Path:
    """Folder of the compiled code of exactly these sources."""
    digest = hashlib.sha256()
    for path in sorted(_HERE.rglob("*.py")):
        digest.update(str(path.relative_to(_HERE)).encode() + b"\0" + path.read_bytes())
    base = _HERE.parent / "build"
    if not os.access(base if base.is_dir() else base.parent, os.W_OK):
        base = Path(os.environ.get("XDG_CACHE_HOME", "~/.cache")).expanduser() / "diarc-ecu"
    return base / "numba" / digest.hexdigest()[:16]


COMPILED = _cache_folder()
os.environ.setdefault("NUMBA_CACHE_DIR", str(COMPILED))
