"""What a potential must offer to calmwalk, and what it says about itself."""

from __future__ import annotations

import hashlib
import inspect
import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Optional, Protocol

import numpy as np

from .batch import Batch
from .errors import InputError


@dataclass(frozen=True)
class Features:
    """The numbers per atom that CALM grades."""

    form: str
    """"final": used as they are; "raw": invariants that calmwalk normalises and projects; "none": energies and forces
    only."""
    blocks: Sequence[int] = ()
    """Number of columns of each layer; their sum is the dimension D."""

    @property
    def dimension(self) -> int:
        """D, columns of the feature matrix."""
        return sum(self.blocks)


@dataclass(frozen=True)
class ModelInfo:
    """What an adapter says about its model, once, at the start."""

    elements: Sequence[str]
    """Chemical symbols; `Batch.species` counts in this order."""
    cutoffs: np.ndarray
    """[elements, elements]: longest bond that contributes, by the elements of centre and neighbour, Å."""
    features: Features
    identity: str
    """Hash of the model files, the adapter's source and the definition of the features; see `identity`."""
    precision: str = "double"
    """"double" or "single": what the model computes in. Arrays are exchanged in double precision all the same."""
    device: str = "cpu"
    padding: bool = False
    """Whether each new shape of a batch must be compiled, so that calmwalk pads batches to few shapes."""
    needs_positions: bool = False
    """Whether the adapter builds its own neighbour list from positions and cells, and so cannot use bonds."""
    max_structures: Optional[int] = None
    """Largest batch, if the model has a limit of its own."""
    versions: Mapping[str, str] = field(default_factory=dict)
    """Versions of the framework and the model's package."""
    projection: Optional[Mapping[str, Any]] = None
    """For final features: the map from the model's invariants, if it is known."""


@dataclass
class Evaluation:
    """Energies and forces of a batch of A atoms in S structures."""

    energies: np.ndarray
    """[A], eV."""
    features: Optional[np.ndarray]
    """[A, D]; None if they were not asked for."""
    forces: np.ndarray
    """[A, 3]: −∂E/∂r, eV/Å."""
    virials: np.ndarray
    """[S, 3, 3]: −∂E/∂ε, eV, symmetric."""
    compiled: bool = False
    """Whether this call compiled code for a new shape."""


@dataclass
class Energies:
    """What an evaluation without forces gives."""

    energies: np.ndarray
    """[A], eV."""
    features: np.ndarray
    """[A, D]."""
    compiled: bool = False
    """Whether this call compiled code for a new shape."""


@dataclass
class Gradients:
    """Derivatives of H = Σ_i ē_i E_i + Σ_i z̄_i·z_i, where ē and z̄ are the cotangents of energies and features."""

    gradients: np.ndarray
    """[A, 3]: +∂H/∂r."""
    virials: np.ndarray
    """[S, 3, 3]: +∂H/∂ε."""
    compiled: bool = False
    """Whether this call compiled code for a new shape."""


class Adapter(Protocol):
    """A potential behind calmwalk. It is constructed with `(model: Path | None, options: dict, device: str,
    precision: str, threads: int, cache: Path | None)`, all from the configuration.

    Not a single result may depend on what else is in the batch: each atom sees its own structure only.

    It may have one more method, `evaluate_without_forces(batch) -> Energies`: energies and features as of `evaluate`,
    without the gradient that forces take. A pull-back with cotangents of energies and features then gives forces and
    bias at once (`walk.bias_norm_interval`).
    """

    info: ModelInfo

    def evaluate(self, batch: Batch, features: bool) -> Evaluation:
        """Energies, forces and virials, and the features if they are asked for. May leave its graph in `batch.kept`."""
        ...

    def pull_back(
        self, batch: Batch, feature_cotangents: np.ndarray, energy_cotangents: Optional[np.ndarray] = None
    ) -> Gradients:
        """Gradient of Σ z̄·z, z̄ of the shape [A, D], plus Σ ē·E, ē of the shape [A], if it is given. `batch.kept` is
        what the evaluation of the same inputs left there, or None: then compute forward again."""
        ...


def identity(files: Iterable[Path], adapter: type, definition: Any = None) -> str:
    """Hash of the names' order and contents of files, of the adapter's source, and of a definition of the features
    (anything that JSON holds): 64 hexadecimal digits."""
    digest = hashlib.sha256()
    for file in files:
        digest.update(hashlib.sha256(file.read_bytes()).digest())
    digest.update(hashlib.sha256(_source(adapter)).digest())
    digest.update(json.dumps(definition, sort_keys=True).encode())
    return digest.hexdigest()


def _source(adapter: type) -> bytes:
    module = sys.modules[adapter.__module__]
    file = getattr(module, "__file__", None)
    return Path(file).read_bytes() if file else inspect.getsource(adapter).encode()


def check_options(options: Mapping[str, Any], known: Iterable[str]) -> None:
    """Refuses an option that the adapter does not know."""
    known = sorted(known)
    for name in sorted(set(options) - set(known)):
        listed = ", ".join(known) if known else "none"
        raise InputError(f"unknown option '{name}'; the options are: {listed}")


def model_path(model: Optional[Path], what: str) -> Path:
    """The path of a model that must be there; `what` says what kind of file or folder is expected."""
    if model is None:
        raise InputError(f"no model is given; expected {what}")
    if not model.exists():
        raise InputError(f"{model} does not exist; expected {what}")
    return model


def same_cutoff(elements: Sequence[str], cutoff: float) -> np.ndarray:
    """One cutoff, Å, for all pairs of elements: [elements, elements]."""
    return np.full((len(elements), len(elements)), float(cutoff))
