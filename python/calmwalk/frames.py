"""Structures of a campaign as ASE Atoms, with the names of `calmwalk export --keys ase` (docs/export.md)."""

from __future__ import annotations

from typing import Any

import numpy as np

from .blocks import Structure
from .records import Candidate, Imported, Label
from .store_errors import MissingPackage

# Retry adjustments that depend on the machine and change no label (crates/dft/src/retry_adjustment.rs).
_OF_RESOURCES = {"more_memory", "more_time", "other_node"}

# Two atoms are bonded within this multiple of the sum of their covalent radii (crates/atoms/src/fragments.rs).
_BOND_FACTOR = 1.25
# Elements beyond have its radius.
_CURIUM = 96


def structure_atoms(structure: Structure) -> Any:
    """The structure as :class:`ase.Atoms`."""
    try:
        from ase import Atoms
    except ImportError:
        raise MissingPackage("structures as ASE Atoms need ase: pip install ase") from None
    return Atoms(
        numbers=structure.numbers, positions=structure.positions, cell=structure.cell, pbc=structure.pbc
    )


def count_fragments(atoms: Any) -> int:
    """Number of sets of atoms that are joined by bonds."""
    from ase.data import covalent_radii
    from ase.neighborlist import neighbor_list

    radii = covalent_radii[np.minimum(atoms.numbers, _CURIUM)]
    first, second = neighbor_list("ij", atoms, _BOND_FACTOR * radii)
    bonded: list[list[int]] = [[] for _ in range(len(atoms))]
    for one, other in zip(first, second, strict=True):
        bonded[one].append(int(other))
    seen: set[int] = set()
    fragments = 0
    for start in range(len(atoms)):
        if start in seen:
            continue
        fragments += 1
        seen.add(start)
        waiting = [start]
        while waiting:
            new = {other for other in bonded[waiting.pop()] if other not in seen}
            seen |= new
            waiting.extend(new)
    return fragments


def candidate_atoms(candidate: Candidate, campaign: str, has_versions: bool) -> Any:
    """A candidate; its label, if it has one, is the result of the frame's calculator.

    The potential's own energy, forces and virial are ``model_energy`` (eV), ``model_virial`` (eV) and ``model_forces``
    (eV/Å). ``gamma`` and ``gamma_nbr`` are those of the original mixture, whose largest γ is ``gamma_max_original``;
    ``gamma_max`` is that under the mixture at the decision.
    """
    atoms = structure_atoms(candidate.structure)
    info: dict[str, Any] = {"campaign": campaign, "fragments": count_fragments(atoms)}
    if candidate.label:
        _add_label(atoms, candidate.label, info)
    info |= {"candidate_id": candidate.id, "seed_structure": candidate.seed_structure_name}
    info |= {"walk": candidate.walk, "segment": candidate.segment, "step": candidate.step}
    info["origin"] = candidate.origin
    if conditions := candidate.conditions:
        if conditions.group:
            info["group"] = conditions.group
        info |= {"temperature": conditions.temperature, "tau": conditions.tau}
    if has_versions:
        info["calmwalk_version"] = candidate.conditions.version if candidate.conditions else 0
    info |= {
        "mixture_version": candidate.mixture_version,
        "mixture_version_seen": candidate.mixture_version_seen,
        "relative_volume": candidate.relative_volume,
        "decision": candidate.decision,
        "fate": candidate.fate,
        "model_energy": candidate.energy,
        "model_virial": candidate.virial,
    }
    if candidate.reason:
        info["reason"] = candidate.reason
    for key, gamma in (("gamma_max", candidate.selector_gamma), ("gamma_max_original", candidate.original_gamma)):
        if gamma is not None:
            info[key] = float(np.max(gamma))
    atoms.info = info
    if candidate.original_gamma is not None and candidate.original_gamma_nbr is not None:
        atoms.arrays["gamma"] = np.array(candidate.original_gamma)
        atoms.arrays["gamma_nbr"] = np.array(candidate.original_gamma_nbr)
    atoms.arrays["model_forces"] = np.array(candidate.forces)
    return atoms


def imported_atoms(imported: Imported, campaign: str) -> Any:
    """An imported structure."""
    atoms = structure_atoms(imported.structure)
    info: dict[str, Any] = {"campaign": campaign, "fragments": count_fragments(atoms)}
    if imported.label:
        _add_label(atoms, imported.label, info)
    info |= {"origin": "imported", "source_file": imported.file, "source_frame": imported.frame}
    atoms.info = info
    return atoms


def _add_label(atoms: Any, label: Label, info: dict[str, Any]) -> None:
    from ase.calculators.singlepoint import SinglePointCalculator

    results: dict[str, Any] = {"energy": label.energy, "forces": np.array(label.forces)}
    if label.stress is not None:
        s = label.stress
        # Voigt order: xx, yy, zz, yz, xz, xy.
        results["stress"] = np.array([s[0, 0], s[1, 1], s[2, 2], s[1, 2], s[0, 2], s[0, 1]])
    details = label.details
    if details.get("magnetic_moments") is not None:
        results["magmoms"] = np.array(details["magnetic_moments"])
    if details.get("magnetisation") is not None:
        results["magmom"] = details["magnetisation"]
    atoms.calc = SinglePointCalculator(atoms, **results)
    info |= {"protocol": label.protocol, "protocol_hash": label.protocol_hash[:16]}
    if details.get("energy_without_smearing") is not None:
        info["energy_without_smearing"] = details["energy_without_smearing"]
    adjustments = [name for name in details.get("retry_adjustments", []) if name not in _OF_RESOURCES]
    if adjustments:
        info["retry_adjustments"] = ",".join(adjustments)
