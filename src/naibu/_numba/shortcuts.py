# mypy: disallow-untyped-calls=False, warn-unused-ignores=False
"""Ways on which Numba's compiler comes to the same code in less time: a quarter to a third of a compilation, most of which is Python.

They take the place of functions of Numba while a kernel of naibu is compiled (`taken`), and nothing of them stays afterwards:

- how long compilers and LLVM held their locks is measured for the outermost kernel, not once more for each kernel that is called: where
  calls are nested, each of some ten thousand calls of LLVM told all levels of it;
- options of a compilation are compared as they were set, not option by option through a property each;
- variables of a statement are listed by what is known of the types of its parts;
- how an operator acts on numbers and arrays is found once, not for each place where it stands: some twenty templates are tried each time;
- which variables are alive at each block's begin is found for those who ask, which are generators and compilations for the interpreter;
- what was registered with Numba is gone through again when there is more of it, not once more for each kernel that is called;
- the size of a plain type is asked of LLVM once;
- whether a function of Numba takes a place in the source as an argument is read from its code, not from a signature made of it each time;
- wrappers for callers in C are not made of those functions of Numba that kernels call.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from types import FunctionType
from typing import Any

from numba.core import analysis, base, event, ir, lowering, postproc, targetconfig, transforms, types
from numba.core.types import functions
from numba.core.typing import context as typing_context

LINKED_ONLY = "linked_only"  # what libraries have that are never made into machine code

_find_call_type: Any = functions.BaseFunction.get_call_type
_process: Any = postproc.PostProcessor.run
_refresh: Any = base.BaseContext.refresh
_refresh_typing: Any = typing_context.BaseContext.refresh
_find_size: Any = base.BaseContext.get_abi_sizeof
_wrap_for_c: Any = lowering.BaseLower.create_cfunc_wrapper
_hash_of_names: Any = targetconfig.TargetConfig.__hash__  # the same for all configurations of a class
_takes_place: Any = base._has_loc
_NUMBERS = (types.Integer, types.Float, types.Boolean, types.IntegerLiteral, types.BooleanLiteral)

_defaults: dict[type, dict[str, Any]] = {}
_hashes: dict[type, int] = {}
_adders: dict[type, Callable[[Any, list[Any]], object]] = {}
_plain: dict[Any, bool] = {}
# what acts on numbers and arrays, by the identities of function and context, which are kept with it, and types
_found: dict[tuple[int, int, tuple[Any, ...]], tuple[Any, Any, Any]] = {}
# how much was registered with a context when it was refreshed, by its identity; it is kept with it, as the layout of data is
_registered: dict[int, tuple[Any, int]] = {}
_sizes: dict[tuple[int, str], tuple[Any, int]] = {}


@contextlib.contextmanager
def taken() -> Iterator[None]:
    """Within this context, Numba's compiler takes these ways. Numba's lock of the compiler is held."""
    config: Any = targetconfig.TargetConfig
    before = [(owner, name, vars(owner)[name]) for owner, name, _ in _substitutes(config)]
    for owner, name, substitute in _substitutes(config):
        setattr(owner, name, substitute)
    try:
        yield
    finally:
        for owner, name, original in before:
            setattr(owner, name, original)


def _substitutes(config: Any) -> tuple[tuple[Any, str, Any], ...]:
    return (
        (event, "install_timer", _no_timer),
        (config, "values", _values),
        (config, "__hash__", _hash),
        (config, "__eq__", _equal),
        (ir.Inst, "_rec_list_vars", _variables),
        (functions.BaseFunction, "get_call_type", _call_type),
        (postproc.PostProcessor, "run", _processed),
        (base.BaseContext, "refresh", _refreshed),
        (typing_context.BaseContext, "refresh", _refreshed_typing),
        (base.BaseContext, "get_abi_sizeof", _size),
        (lowering.BaseLower, "create_cfunc_wrapper", _wrapped_for_c),
        (base, "_has_loc", _takes_place_in_source),
    )


def _no_timer(kind: str, callback: Any) -> contextlib.AbstractContextManager[None]:
    return contextlib.nullcontext()


def _values(self: Any) -> dict[str, Any]:
    kind = type(self)
    defaults = _defaults.get(kind)
    if defaults is None:
        defaults = _defaults[kind] = {name: option.default for name, option in kind.options.items()}
    return {**defaults, **self._values}


def _hash(self: Any) -> int:
    kind = type(self)
    known = _hashes.get(kind)
    if known is None:
        known = _hashes[kind] = _hash_of_names(self)
    return known


def _equal(self: Any, other: Any) -> Any:
    if self is other:
        return True
    if not isinstance(other, targetconfig.TargetConfig):
        return NotImplemented
    return self._values == other._values or _values(self) == _values(other)


def _variables(self: Any, value: Any) -> list[Any]:
    found: list[Any] = []
    _add_variables(value, found)
    return found


def _add_variables(value: Any, found: list[Any]) -> None:
    kind = type(value)
    add = _adders.get(kind)
    if add is None:
        add = _adders[kind] = _adder(kind)
    add(value, found)


def _adder(kind: type) -> Callable[[Any, list[Any]], object]:
    if issubclass(kind, ir.Var):
        return lambda value, found: found.append(value)
    if issubclass(kind, ir.Inst):
        return lambda value, found: found.extend(value.list_vars())
    if issubclass(kind, list | tuple):
        return _add_those_of_items
    if issubclass(kind, dict):
        return lambda value, found: _add_those_of_items(value.values(), found)
    return lambda value, found: None


def _add_those_of_items(items: Any, found: list[Any]) -> None:
    for item in items:
        _add_variables(item, found)


def _is_plain(kind: Any) -> bool:
    known = _plain.get(kind)
    if known is None:
        known = _plain[kind] = isinstance(kind, (*_NUMBERS, types.Array)) or (isinstance(kind, types.UniTuple) and _is_plain(kind.dtype))
    return known


def _call_type(self: Any, context: Any, args: Any, kws: Any) -> Any:
    if kws or not all(map(_is_plain, args)):
        return _find_call_type(self, context, args, kws)
    key = (id(self), id(context), tuple(args))
    known = _found.get(key)
    if known is None:
        signature = _find_call_type(self, context, args, kws)
        # what is written in Python for several types is compiled by the options of the kernel that calls it: it is looked for each time
        if self._impl_keys[signature.args] is self.typing_key:
            _found[key] = (self, context, signature)
        return signature
    signature = known[2]
    self._impl_keys[signature.args] = self.typing_key
    return signature


class _AliveAtBegin(dict[Any, Any]):
    """Variables that are alive where a block begins, by block: of all blocks as soon as one is asked for."""

    def __init__(self, lifetime: Any, blocks: dict[int, Any]) -> None:
        super().__init__()
        self._lifetime, self._blocks = lifetime, blocks

    def __missing__(self, block: Any) -> Any:
        alive = analysis.compute_live_variables(
            self._lifetime.cfg, self._blocks, self._lifetime.usedefs.defmap, self._lifetime.deadmaps.combined
        )
        self.update((one, alive[offset]) for offset, one in self._blocks.items())
        return dict(self)[block]


def _processed(self: Any, emit_dels: bool = False, extend_lifetimes: bool = False) -> None:
    code = self.func_ir
    if code.is_generator:
        _process(self, emit_dels, extend_lifetimes)
        return
    code.blocks = transforms.canonicalize_cfg(code.blocks)
    code.variable_lifetime = postproc.VariableLifetime(code.blocks)
    code.block_entry_vars = _AliveAtBegin(code.variable_lifetime, code.blocks)
    code.generator_info = None
    if emit_dels:
        self._insert_var_dels(extend_lifetimes=extend_lifetimes)


def _how_many(context: Any) -> int:
    """Return how much was registered with a context; nothing is ever taken away."""
    return sum(len(getattr(registry, name)) for registry, loader in context._registries.items() for name in loader.registry_items)


def _is_fresh(context: Any) -> bool:
    known = _registered.get(id(context))
    return known is not None and known[1] == _how_many(context)


def _refreshed(self: Any) -> None:
    if _is_fresh(self):
        self.typing_context.refresh()
        return
    _refresh(self)
    _registered[id(self)] = self, _how_many(self)


def _refreshed_typing(self: Any) -> None:
    if not _is_fresh(self):
        _refresh_typing(self)
        _registered[id(self)] = self, _how_many(self)


def _size(self: Any, kind: Any) -> int:
    text = str(kind)
    if "%" in text:  # types with names may mean something else elsewhere
        return int(_find_size(self, kind))
    layout = self.target_data
    known = _sizes.get((id(layout), text))
    if known is None:
        known = _sizes[id(layout), text] = layout, _find_size(self, kind)
    return known[1]


def _wrapped_for_c(self: Any) -> None:
    if not getattr(self.library, LINKED_ONLY, False):
        _wrap_for_c(self)


def _takes_place_in_source(function: Any) -> bool:
    if type(function) is not FunctionType or vars(function):  # attributes of a decorator may stand for another signature
        return bool(_takes_place(function))
    code = function.__code__
    return "loc" in code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]
