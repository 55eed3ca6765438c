"""A compiler of functions that are inlined and never compiled alone."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

from numba.core import ir
from numba.core.analysis import compute_cfg_from_blocks, compute_use_defs, must_use_alloca
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase
from numba.core.compiler_machinery import PassManager, register_pass
from numba.core.datamodel.packer import ArgPacker
from numba.core.lowering import Lower
from numba.core.registry import cpu_target
from numba.core.typed_passes import (
    BaseNativeLowering,
    IRLegalization,
    NoPythonBackend,
    NopythonTypeInference,
    PreLowerStripPhis,
)
from numba.core.untyped_passes import (
    DeadBranchPrune,
    FixupArgs,
    GenericRewrites,
    IRProcessing,
    ReconstructSSA,
    RewriteSemanticConstants,
    TranslateByteCode,
)


class Whole(tuple[Any, ...]):
    """The types of arguments that are passed as they are."""

    # Numba takes arguments apart, down to each length of an array: some hundred numbers for the
    # engine's named tuples. To pack and unpack them would be most of a rule's code.


class _WholePacker:
    def __init__(self, models: Any, kinds: Whole) -> None:
        self.argument_types = tuple(models.lookup(kind).get_value_type() for kind in kinds)

    def as_arguments(self, builder: Any, values: Any) -> Any:
        return values

    def from_arguments(self, builder: Any, arguments: Any) -> Any:
        return arguments

    def assign_names(self, arguments: Any, names: Any) -> None:
        for argument, name in zip(arguments, names, strict=True):
            argument.name = name


def _packer(kinds: tuple[Any, ...]) -> Any:
    models = cpu_target.target_context.data_model_manager
    make: Any = _WholePacker if isinstance(kinds, Whole) else ArgPacker
    return make(models, kinds)


cpu_target.target_context.get_arg_packer = _packer  # both ends of a call ask it


class _PartLowering(Lower):
    """Writes a rule's code, with arguments as they are and no memory for what has one value."""

    # Numba keeps a variable that several basic blocks use in memory, so that each use of a named
    # tuple of arrays copies all of it, and the optimiser has to take the copies apart.
    def __init__(self, context: Any, library: Any, function: Any, *rest: Any, **named: Any) -> None:
        function.argtypes = Whole(function.argtypes)
        super().__init__(context, library, function, *rest, **named)  # type: ignore[no-untyped-call]

    def _find_singly_assigned_variable(self) -> None:
        blocks = self.func_ir.blocks
        above = compute_cfg_from_blocks(blocks).dominators()  # type: ignore[no-untyped-call]
        uses = compute_use_defs(blocks).usemap  # type: ignore[no-untyped-call]
        places = defaultdict(list)
        for label, block in blocks.items():
            for assignment in block.find_insts(ir.Assign):
                places[assignment.target.name].append(label)
        self._blk_local_varmap: dict[str, Any] = {}
        self._singly_assigned_vars = {
            name
            for name, labels in places.items()
            if len(labels) == 1 and all(labels[0] in above[at] for at in above if name in uses[at])
        } - must_use_alloca(blocks)  # type: ignore[no-untyped-call]


@register_pass(mutates_CFG=True, analysis_only=False)  # type: ignore[no-untyped-call]
class _LowerPart(BaseNativeLowering):
    """Takes the place of ``NativeLowering`` for a rule."""

    _name = "lower_part"  # type: ignore[assignment]

    @property
    def lowering_class(self) -> type[Lower]:
        return _PartLowering


class _NoEnvironment:
    """Takes a function's globals, which without machine code nobody needs."""

    def set_env(self, name: str, environment: Any) -> None:
        pass


class _Part(JITCodeLibrary):
    """Code that others link and optimise; none of it becomes machine code by itself."""

    codegen = _NoEnvironment()

    def get_pointer_to_function(self, name: str) -> int:
        """Return 0, by which Numba means a function that is not in memory."""
        return 0

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalized = True


# Numba's passes, without those for closures, contexts, exceptions, loops over tuples and array
# expressions, which rules do not have.
PASSES = (
    *(TranslateByteCode, FixupArgs, IRProcessing),
    *(RewriteSemanticConstants, GenericRewrites, DeadBranchPrune, ReconstructSSA),
    *(NopythonTypeInference, PreLowerStripPhis),
    *(IRLegalization, _LowerPart, NoPythonBackend),
)


class PartCompiler(CompilerBase):
    def __init__(self, typing: Any, target: Any, library: Any, *rest: Any) -> None:
        part = _Part(target.codegen(), "part")  # type: ignore[no-untyped-call]
        super().__init__(typing, target, part, *rest)  # type: ignore[no-untyped-call]

    def define_pipelines(self) -> list[Any]:
        passes: Any = PassManager("part")  # type: ignore[no-untyped-call]
        for one in PASSES:
            passes.add_pass(one)
        passes.finalize()
        return [passes]
