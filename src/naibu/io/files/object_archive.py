"""Objects of naibu's data classes in npz files: arrays and JSON, so that reading a file never executes what somebody wrote into it.

An object is stored as the name of its class and its attributes. Reading looks that class up among those of ``naibu.core`` and
``naibu.imaging`` that are loaded, makes an instance without calling anything, and gives it the attributes. Objects that are referred to
twice are one object again.
"""

from __future__ import annotations

import io
import json
import math
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from naibu.core.arrays import AnyArray
from naibu.core.errors import InputError

PACKAGES = ("naibu.core.", "naibu.imaging.")
_TREE = "tree"
_PLAIN = (bool, int, str, type(None))


def packed(value: Any) -> bytes:
    """Return the archive of a value.

    Parameters
    ----------
    value : Any
        None, numbers, texts, paths, slices, arrays, NumPy scalars, tuples, lists, dictionaries with keys of text, classes' instances from
        ``naibu.core`` and ``naibu.imaging``, and combinations of them.

    Raises
    ------
    TypeError
        Something else in it.
    """
    writer = _Writer()
    tree = {"objects": writer.objects, "root": writer.told(value)}
    told = np.frombuffer(json.dumps(tree).encode(), np.uint8)
    out = io.BytesIO()
    np.savez(out, allow_pickle=False, **{_TREE: told}, **{f"a{k}": a for k, a in enumerate(writer.arrays)})
    return out.getvalue()


def unpacked(path: Path) -> Any:
    """Return the value of an archive.

    Parameters
    ----------
    path : Path
        File with what `packed` returned.

    Raises
    ------
    InputError
        No such archive, or a damaged one.
    """
    try:
        with np.load(path, allow_pickle=False) as stored:
            tree = json.loads(stored[_TREE].tobytes())
            return _Reader(tree["objects"], {name: stored[name] for name in stored.files}).value(tree["root"])
    except (ValueError, KeyError, IndexError, TypeError, EOFError, AttributeError, RecursionError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: is damaged ({error})") from error


class _Writer:
    """Arrays and objects of a value, each once."""

    def __init__(self) -> None:
        self.arrays: list[AnyArray] = []
        self.objects: list[Any] = []
        self._numbers: dict[int, int] = {}
        self._alive: list[Any] = []  # so that no number of an object is given anew

    def told(self, value: Any) -> Any:
        if isinstance(value, np.generic):
            return {"scalar": self._number(np.asarray(value))}
        if isinstance(value, float) and not math.isfinite(value):
            return {"float": str(value)}
        if isinstance(value, (float, *_PLAIN)) and type(value) in (float, *_PLAIN):
            return value
        if isinstance(value, Path):
            return {"path": str(value)}
        if isinstance(value, slice):
            return {"slice": [self.told(v) for v in (value.start, value.stop, value.step)]}
        if type(value) is tuple:
            return {"tuple": [self.told(v) for v in value]}
        return {"object": self._referred(value)}

    def _referred(self, value: Any) -> int:
        if id(value) in self._numbers:
            return self._numbers[id(value)]
        number = len(self.objects)
        self._numbers[id(value)] = number
        self._alive.append(value)
        self.objects.append(None)
        self.objects[number] = self._content(value)
        return number

    def _content(self, value: Any) -> Any:
        if type(value) is np.ndarray and value.dtype.kind in "biufc":
            return {"array": self._number(value)}
        if type(value) is list:
            return {"list": [self.told(v) for v in value]}
        if type(value) is dict and all(type(k) is str for k in value):
            return {"dict": {k: self.told(v) for k, v in value.items()}}
        kind = type(value)
        if not kind.__module__.startswith(PACKAGES) or issubclass(kind, BaseException):
            raise TypeError(f"{kind.__module__}.{kind.__qualname__} cannot be archived")
        return {"class": [kind.__module__, kind.__qualname__], "state": {k: self.told(v) for k, v in _attributes(value)}}

    def _number(self, array: AnyArray) -> str:
        # a view of one value everywhere, such as a grid without values, takes no room
        repeated = array.size > 1 and not any(array.strides)
        self.arrays.append(array[(slice(1),) * array.ndim].reshape(1) if repeated else np.ascontiguousarray(array).reshape(array.shape))
        return f"a{len(self.arrays) - 1}" + (":" + ",".join(map(str, array.shape)) if repeated else "")


def _attributes(value: Any) -> Iterator[tuple[str, Any]]:
    for kind in type(value).__mro__:
        names = kind.__dict__.get("__slots__", ())
        for name in (names,) if isinstance(names, str) else names:
            if name not in ("__dict__", "__weakref__") and hasattr(value, name):
                yield name, getattr(value, name)
    yield from getattr(value, "__dict__", {}).items()


class _Reader:
    """Makes objects of what was told of them."""

    def __init__(self, objects: list[Any], arrays: dict[str, AnyArray]) -> None:
        self._told, self._arrays = objects, arrays
        self._made: dict[int, Any] = {}

    def value(self, told: Any) -> Any:
        if not isinstance(told, dict):
            return told
        ((kind, content),) = told.items()
        if kind == "scalar":
            return self._array(content)[()]
        if kind == "float":
            return float(content)
        if kind == "path":
            return Path(content)
        if kind == "slice":
            return slice(*(self.value(v) for v in content))
        if kind == "tuple":
            return tuple(self.value(v) for v in content)
        return self._object(int(content))

    def _object(self, number: int) -> Any:
        if number in self._made:
            return self._made[number]
        told = self._told[number]
        if "array" in told:
            self._made[number] = self._array(told["array"])
        elif "list" in told:
            self._made[number] = []
            self._made[number].extend(self.value(v) for v in told["list"])
        elif "dict" in told:
            self._made[number] = {}
            self._made[number].update((k, self.value(v)) for k, v in told["dict"].items())
        else:
            kind = _class(*told["class"])
            made: Any = object.__new__(kind)
            self._made[number] = made
            for name, v in told["state"].items():
                object.__setattr__(made, name, self.value(v))
        return self._made[number]

    def _array(self, name: str) -> AnyArray:
        stored, _, shape = name.partition(":")
        array = self._arrays[stored]
        return np.broadcast_to(array[0], tuple(int(n) for n in shape.split(","))) if shape else array


def _class(module: str, name: str) -> type:
    """Return a class of naibu's data, by its name.

    Raises
    ------
    ValueError
        It is none.
    """
    found = getattr(sys.modules.get(module), name, None) if module.startswith(PACKAGES) else None
    if not isinstance(found, type) or found.__module__ != module or issubclass(found, BaseException):
        raise ValueError(f"{module}.{name} is no class of naibu's data")
    return found
