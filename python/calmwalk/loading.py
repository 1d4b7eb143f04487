"""Finds the adapter that a name stands for."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from pathlib import Path
from typing import Any

from .errors import InputError

BUILT_IN = {
    "ase": "calmwalk.adapters.ase:Ase",
    "gracemaker": "calmwalk.adapters.gracemaker:Gracemaker",
    "mace": "calmwalk.adapters.mace:Mace",
    "radial": "calmwalk.adapters.radial:Radial",
    "simulated": "calmwalk.adapters.simulated:Simulated",
}


def find_adapter(name: str) -> type:
    """The class of a built-in adapter, of "module:ClassName" or of "/path/file.py:ClassName"."""
    where, _, attribute = BUILT_IN.get(name, name).rpartition(":")
    if not where:
        names = ", ".join(BUILT_IN)
        expected = f"one of {names}, 'module:ClassName' or '/path/file.py:ClassName'"
        raise InputError(f"the adapter is '{name}', expected {expected}")
    found: type = getattr_or_refuse(load_module(where), attribute)
    return found


def load_module(where: str) -> Any:
    """A module by its name or by the path of its file."""
    if not where.endswith(".py"):
        return importlib.import_module(where)
    file = Path(where).resolve()
    if not file.is_file():
        raise InputError(f"{where} does not exist; expected a Python file")
    name = f"calmwalk_file_{file.stem}"
    spec = importlib.util.spec_from_file_location(name, file)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


def getattr_or_refuse(module: Any, attribute: str) -> Any:
    """An attribute of a module. InputError if it has none of that name."""
    if not hasattr(module, attribute):
        raise InputError(f"{getattr(module, '__file__', None) or module.__name__} has no '{attribute}'")
    return getattr(module, attribute)
