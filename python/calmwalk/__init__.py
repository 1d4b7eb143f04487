"""calmwalk for Python: adapters that put a potential behind calmwalk's walkers, and reading of campaigns.

Names are imported when they are first used, so that the server can set the number of threads before numpy loads.
"""

from __future__ import annotations

import importlib
from typing import Any

_HOME = {
    "Adapter": "adapter",
    "AdapterError": "errors",
    "Batch": "batch",
    "Energies": "adapter",
    "Evaluation": "adapter",
    "Features": "adapter",
    "Gradients": "adapter",
    "InputError": "errors",
    "ModelInfo": "adapter",
    "scatter": "batch",
}

__all__ = sorted([*_HOME, "open"])


def open(location: Any) -> Any:
    """Open a campaign for reading: see :func:`calmwalk.campaign.open_campaign`."""
    from .campaign import open_campaign

    return open_campaign(location)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'calmwalk' has no attribute '{name}'")
    return getattr(importlib.import_module(f"calmwalk.{_HOME[name]}"), name)
