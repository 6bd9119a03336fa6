"""How the rig's functions are compiled.

All arrays of a run belong to its session for as long as compiled code works on them, so compiled code only borrows
them: it does not count references (half of the time of a tick, once) and may not make arrays. Small functions, and
those that every tick calls once, become part of their caller; the tuples they are given then cost nothing.
"""

from __future__ import annotations

from numba import njit

# One's own machine code; for functions with several callers and no short way through.
compiled = njit(cache=True, _nrt=False)
# Part of each caller.
inlined = njit(cache=True, _nrt=False, forceinline=True)
