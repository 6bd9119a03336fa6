"""The plant's compiled equations as an object file for a C linker: what other tools load needs no Python.

numba has compiled :mod:`sil_plant.plant.dynamics` for this process anyhow; the same intermediate code is given to LLVM
once more, for any processor of this architecture, and without what ties it to Python.
"""

from __future__ import annotations

import functools
from typing import Any

import llvmlite.binding as llvm
import numpy as np
from numba import carray, njit, types

from sil_plant.loop.io_node import make_node
from sil_plant.plant.dynamics import STATES, PlantParameters, integrate, rest

STEP, REST = "diarc_plant_step", "diarc_plant_rest"
SCRATCH_SHAPE = make_node(np.zeros(STATES), 0.0).scratch.shape
_DOUBLES = types.CPointer(types.float64)


def flatten(parameters: PlantParameters) -> np.ndarray:
    """All numbers of the parameters in one vector; :func:`slots` says where each is."""
    return np.concatenate([np.atleast_1d(np.asarray(value, dtype=np.float64)).ravel() for value in parameters])


def slots(parameters: PlantParameters) -> dict[str, list[int]]:
    """Places of each field in the vector of :func:`flatten`."""
    places, at = {}, 0
    for name, value in zip(parameters._fields, parameters, strict=True):
        places[name] = list(range(at, at + np.size(value)))
        at += np.size(value)
    return places


Shape = tuple[tuple[str, int], ...]  # names of the fields, and their sizes; 0: a number


def _shape(parameters: PlantParameters) -> Shape:
    sizes = (value.size if isinstance(value, np.ndarray) else 0 for value in parameters)
    return tuple(zip(parameters._fields, sizes, strict=True))


def _unflatten(shape: Shape) -> Any:
    """Compiled function that makes the parameters from their vector; numba builds such a tuple from a call only."""
    arguments, at = [], 0
    for _, size in shape:
        arguments.append(f"v[{at}:{at + size}]" if size else f"v[{at}]")
        at += max(size, 1)
    scope = {"PlantParameters": PlantParameters}
    exec(f"def unflatten(v):\n    return PlantParameters({', '.join(arguments)})\n", scope)
    return njit(scope["unflatten"])


def plant_object(parameters: PlantParameters) -> bytes:
    """Object file of the plant for this machine's architecture.

    It defines two C functions that keep no state and return 0 when all is well::

        int32_t diarc_plant_step(void **nothing, void **error, double *y, const double *u, double load_kg,
                                 const double *parameters, double duration_s, double *scratch);
        int32_t diarc_plant_rest(int64_t *joint, void **error, const double *q, double load_kg,
                                 const double *parameters, double *y);

    Parameters
    ----------
    parameters : PlantParameters
        Any arm: only the shapes matter.
    """
    return _object(_shape(parameters))


@functools.cache
def _object(shape: Shape) -> bytes:
    unflatten = _unflatten(shape)
    count, scratch_shape = sum(max(size, 1) for _, size in shape), SCRATCH_SHAPE

    def step(y, u, load_kg, values, duration_s, scratch):
        integrate(
            carray(y, (STATES,)),
            carray(u, (2,)),
            load_kg,
            unflatten(carray(values, (count,))),
            duration_s,
            carray(scratch, scratch_shape),
        )

    def at_rest(q, load_kg, values, y):
        return rest(carray(q, (2,)), load_kg, unflatten(carray(values, (count,))), carray(y, (STATES,)))

    real = types.float64
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    module = None
    for name, function, signature in (
        (STEP, step, types.void(_DOUBLES, _DOUBLES, real, _DOUBLES, real, _DOUBLES)),
        (REST, at_rest, types.int64(_DOUBLES, real, _DOUBLES, _DOUBLES)),
    ):
        dispatcher = njit(signature, no_cpython_wrapper=True, no_cfunc_wrapper=True)(function)
        compiled = dispatcher.overloads[dispatcher.signatures[0]]
        part = llvm.parse_assembly(compiled.library.get_llvm_str())
        entry = part.get_function(compiled.fndesc.mangled_name)
        entry.name = name
        for other in part.functions:
            if not other.is_declaration and other.name != name:
                other.linkage = "internal"
        for variable in part.global_variables:
            if not variable.is_declaration:
                variable.linkage = "internal"
        if module is None:
            module = part
        else:
            module.link_in(part)
    assert module is not None
    machine = llvm.Target.from_triple(llvm.get_process_triple()).create_target_machine(opt=2, reloc="pic")
    builder = llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options(speed_level=2))
    builder.getModulePassManager().run(module, builder)
    module.verify()
    return machine.emit_object(module)
