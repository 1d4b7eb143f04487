"""Any calculator of ASE: energies and forces for unbiased walks, control walks and labels. It has no features, so no
grade.

The model is a Python file that defines `calculator`, a calculator or a function without arguments that makes one; or,
without a model, the option `calculator` names a class or function as "module:name" or "/path/file.py:name", called
with the keyword arguments of the option `arguments`.

Other options: `elements`, the symbols that the calculator can treat (all, if not given); `numerical_stress`, true for a
calculator without stress, which then takes twelve more energies a call.

Energies of atoms are the calculator's own where they sum to its energy; else each atom has an equal share. Where the
calculator knows the free energy with which its forces are consistent, that is the energy.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Optional

import ase
import numpy as np
from ase.calculators.calculator import PropertyNotImplementedError
from ase.data import chemical_symbols

from ..adapter import Evaluation, Features, Gradients, ModelInfo, check_options, identity, same_cutoff
from ..batch import Batch
from ..errors import AdapterError, InputError
from ..loading import getattr_or_refuse, load_module

STRAIN = 1e-4
"""Step of numerical stress."""


class Ase:
    """The adapter."""

    def __init__(
        self,
        model: Optional[Path],
        options: dict[str, Any],
        device: str = "cpu",
        precision: str = "double",
        threads: int = 1,
        cache: Optional[Path] = None,
    ) -> None:
        check_options(options, ["calculator", "arguments", "elements", "numerical_stress"])
        self._calculator = make_calculator(model, options)
        self._numerical_stress = bool(options.get("numerical_stress", False))
        elements = [str(element) for element in options.get("elements") or chemical_symbols[1:]]
        for element in elements:
            if element not in chemical_symbols[1:]:
                raise InputError(f"the option 'elements' has {element!r}, expected chemical symbols")
        self._symbols = np.array(elements)
        definition = {key: options.get(key) for key in ("calculator", "arguments")}
        self.info = ModelInfo(
            elements=elements,
            cutoffs=same_cutoff(elements, 0.0),
            features=Features("none"),
            identity=identity(_files(model, options), Ase, definition),
            precision=precision,
            device=device,
            needs_positions=True,
            versions={"ase": ase.__version__},
        )

    def evaluate(self, batch: Batch, features: bool) -> Evaluation:
        energies, forces = np.zeros(batch.n_atoms), np.zeros((batch.n_atoms, 3))
        virials = np.zeros((batch.n_structures, 3, 3))
        for structure, (members, atoms) in enumerate(self._structures(batch)):
            self._reset()
            atoms.calc = self._calculator
            energies[members] = self._energies(atoms)
            forces[members] = atoms.get_forces()
            virials[structure] = self._virial(atoms, forces[members])
        return Evaluation(energies, None, forces, virials)

    def pull_back(
        self, batch: Batch, feature_cotangents: np.ndarray, energy_cotangents: Optional[np.ndarray] = None
    ) -> Gradients:
        raise AdapterError("a calculator of ASE has no features")

    def _structures(self, batch: Batch) -> Iterator[tuple[np.ndarray, ase.Atoms]]:
        """The atoms' indices of each real structure, and the structure."""
        for structure in range(batch.real.structures):
            members = np.flatnonzero(batch.structure_of_atom == structure)
            yield (
                members,
                ase.Atoms(
                    self._symbols[batch.species[members]],
                    positions=batch.positions[members],
                    cell=batch.cells[structure],
                    pbc=batch.periodic[structure].astype(bool),
                ),
            )

    def _reset(self) -> None:
        """Results must not depend on the structure before."""
        if hasattr(self._calculator, "reset"):
            self._calculator.reset()

    def _energy(self, atoms: ase.Atoms) -> float:
        free = "free_energy" in getattr(self._calculator, "implemented_properties", ())
        return float(atoms.get_potential_energy(force_consistent=free))

    def _energies(self, atoms: ase.Atoms) -> np.ndarray:
        total = self._energy(atoms)
        try:
            energies = np.asarray(atoms.get_potential_energies(), dtype=float)
            if energies.shape == (len(atoms),) and abs(energies.sum() - total) <= 1e-8 * max(1.0, abs(total)):
                return energies
        except (NotImplementedError, AttributeError, KeyError):
            pass
        return np.full(len(atoms), total / len(atoms))

    def _virial(self, atoms: ase.Atoms, forces: np.ndarray) -> np.ndarray:
        """−∂E/∂ε, eV."""
        if not atoms.pbc.any():
            moments: np.ndarray = forces.T @ atoms.positions
            virial: np.ndarray = (moments + moments.T) / 2
            return virial
        if self._numerical_stress:
            return self._numerical_virial(atoms)
        try:
            stress: np.ndarray = atoms.get_stress(voigt=False)
            return -stress * float(atoms.get_volume())
        except (NotImplementedError, PropertyNotImplementedError):
            name = type(self._calculator).__name__
            raise AdapterError(
                f"{name} has no stress; the option 'numerical_stress' computes it from energies"
            ) from None

    def _numerical_virial(self, atoms: ase.Atoms) -> np.ndarray:
        virial = np.zeros((3, 3))
        for x in range(3):
            for y in range(x + 1):
                plus, minus = (self._strained_energy(atoms, x, y, sign * STRAIN) for sign in (1, -1))
                virial[x, y] = virial[y, x] = -(plus - minus) / (2 * STRAIN)
        return virial

    def _strained_energy(self, atoms: ase.Atoms, x: int, y: int, step: float) -> float:
        strain = np.eye(3)
        strain[x, y] += step / 2
        strain[y, x] += step / 2
        strained = atoms.copy()
        strained.set_cell(atoms.cell.array @ strain, scale_atoms=True)
        self._reset()
        strained.calc = self._calculator
        return self._energy(strained)


def make_calculator(model: Optional[Path], options: Mapping[str, Any]) -> Any:
    """The calculator of a Python file or of the options. InputError if neither names one."""
    name, arguments = options.get("calculator"), options.get("arguments") or {}
    if name is not None:
        where, _, attribute = str(name).rpartition(":")
        if not where:
            raise InputError(f"the option 'calculator' is {name!r}, expected 'module:name' or '/path/file.py:name'")
        return getattr_or_refuse(load_module(where), attribute)(**arguments)
    if model is None or model.suffix != ".py":
        found = "no model" if model is None else str(model)
        raise InputError(
            f"{found} and no option 'calculator'; expected a Python file that defines 'calculator', or the option"
        )
    made = getattr_or_refuse(load_module(str(model)), "calculator")
    return made if hasattr(made, "get_potential_energy") else made(**arguments)


def _files(model: Optional[Path], options: Mapping[str, Any]) -> list[Path]:
    """The model, and all files that the options name."""
    named = [value for value in (options.get("arguments") or {}).values() if isinstance(value, str)]
    where = str(options.get("calculator") or "").rpartition(":")[0]
    return [Path(name) for name in [str(model or ""), where, *named] if name and Path(name).is_file()]
