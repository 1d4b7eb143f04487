"""Checks of an adapter on small structures: `python -m calmwalk.check ADAPTER MODEL`.

Each check returns an error relative to the largest number that it compares, so that limits do not depend on a model's
units. calmwalk checks a model by itself when it starts one; these are for those who write an adapter.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any, Callable, Optional

import numpy as np

from .adapter import Adapter, Evaluation
from .batch import Batch, Counts
from .loading import find_adapter
from .neighbours import Structure, batch_of
from .server import evaluates_without_forces

STEP = {"double": 1e-4, "single": 1e-2}
"""Step of finite differences, Å or strain."""
LIMIT = {"double": 1e-6, "single": 2e-2}
"""Largest relative error of derivatives."""
ROUNDING = {"double": 1e-11, "single": 2e-5}
"""Largest relative error where only the order of sums differs."""


class Check:
    """The checks of one adapter, with structures of its elements from a random seed."""

    def __init__(self, adapter: Adapter, seed: int = 1, distance: float = 2.6) -> None:
        self.adapter, self.info = adapter, adapter.info
        self._random = np.random.default_rng(seed)
        self._skin = float(np.max(adapter.info.cutoffs)) + 0.5
        self.structures = [self._cluster(distance, 9), self._crystal(distance), self._cluster(distance, 2)]
        largest = batch_of(self.structures, self._skin + 0.5).real
        self._room = Counts(largest.structures + 1, largest.atoms + 1, largest.bonds)

    def all(self) -> dict[str, float]:
        """Relative error of each check, by name."""
        checks: dict[str, Callable[[], float]] = {"forces": self.forces, "virials": self.virials}
        if self.info.features.form != "none":
            checks.update(gradients=self.gradients, gradient_virials=self.gradient_virials, kept_graph=self.kept_graph)
            if evaluates_without_forces(self.adapter) is not None:
                checks.update(without_forces=self.without_forces)
        checks.update(batch=self.batch, permutation=self.permutation, repeat=self.repeat)
        if not self.info.needs_positions:
            checks.update(padding=self.padding, beyond_cutoff=self.beyond_cutoff)
        return {name: check() for name, check in checks.items()}

    def limit(self, check: str) -> float:
        """Largest error with which a check is passed."""
        derivative = check in ("forces", "virials", "gradients", "gradient_virials")
        return (LIMIT if derivative else ROUNDING)[self.info.precision]

    def forces(self) -> float:
        """Forces against central differences of the energy."""
        batch = self._batch()
        forces = self.adapter.evaluate(batch, False).forces
        largest = np.abs(forces).max()
        return max(
            _error(forces[at], -self._slope(self._energy, self._moved(*at)), largest) for at in self._coordinates()
        )

    def virials(self) -> float:
        """Virials against central differences of the energy by strain."""
        virials = self.adapter.evaluate(self._batch(), False).virials
        return max(
            _error(virials[s, x, y], -self._slope(self._energy, self._strained(s, x, y)), np.abs(virials).max())
            for s, x, y in self._strains()
        )

    def gradients(self) -> float:
        """Gradients of random cotangents of features and energies against central differences."""
        gradients, _ = self._pull_back()
        return max(
            _error(gradients[at], self._slope(self._combination, self._moved(*at)), np.abs(gradients).max())
            for at in self._coordinates()
        )

    def gradient_virials(self) -> float:
        """Strain gradients of random cotangents against central differences."""
        _, virials = self._pull_back()
        return max(
            _error(virials[s, x, y], self._slope(self._combination, self._strained(s, x, y)), np.abs(virials).max())
            for s, x, y in self._strains()
        )

    def kept_graph(self) -> float:
        """A pull-back from what an evaluation kept against one that computes forward again."""
        cotangents, energy = self._random_cotangents()
        batch = self._batch()
        self.adapter.evaluate(batch, True)
        kept = self.adapter.pull_back(batch, cotangents, energy)
        anew = self.adapter.pull_back(self._batch(), cotangents, energy)
        twice = self.adapter.pull_back(batch, cotangents, energy)
        pairs = [(kept, anew), (kept, twice)]
        return max(max(_error(a.gradients, b.gradients), _error(a.virials, b.virials)) for a, b in pairs)

    def without_forces(self) -> float:
        """Energies and features of an evaluation without forces, and a pull-back from what it kept."""
        evaluate = evaluates_without_forces(self.adapter)
        assert evaluate is not None
        batch, cotangents = self._batch(), self._random_cotangents()
        plain, n = self.adapter.evaluate(self._batch(), True), batch.real.atoms
        found = evaluate(batch)
        kept, anew = self.adapter.pull_back(batch, *cotangents), self.adapter.pull_back(self._batch(), *cotangents)
        assert plain.features is not None
        pairs = [
            (found.energies[:n], plain.energies[:n]),
            (found.features[:n], plain.features[:n]),
            (kept.gradients, anew.gradients),
            (kept.virials, anew.virials),
        ]
        return max(_error(a, b) for a, b in pairs)

    def batch(self) -> float:
        """One batch of all structures against one batch for each."""
        singles = [self._evaluate([structure]) for structure in self.structures]
        return self._difference(self._evaluate(self.structures), _joined(singles))

    def permutation(self) -> float:
        """Atoms in another order against the results in that order."""
        structure = self.structures[0]
        order = self._random.permutation(len(structure.species))
        moved = Structure(structure.species[order], structure.positions[order])
        one, other = self._evaluate([structure]), self._evaluate([moved])
        one.energies, one.forces = one.energies[order], one.forces[order]
        one.features = None if one.features is None else one.features[order]
        return self._difference(one, other)

    def repeat(self) -> float:
        """The same call twice."""
        return self._difference(self._evaluate(self.structures), self._evaluate(self.structures))

    def padding(self) -> float:
        """A batch with spare structures, atoms and bonds against one without."""
        cutoff = self._skin
        spare = (1, 3, 17)
        padded = self.adapter.evaluate(batch_of(self.structures, cutoff, spare), self._has_features())
        padded.energies, padded.forces, padded.virials = padded.energies[:-3], padded.forces[:-3], padded.virials[:-1]
        padded.features = None if padded.features is None else padded.features[:-3]
        return self._difference(self._evaluate(self.structures), padded)

    def beyond_cutoff(self) -> float:
        """A list with a skin against one up to the cutoff."""
        short = self.adapter.evaluate(self._batch(cutoff=self._skin - 0.5 + 1e-9), self._has_features())
        return self._difference(self._evaluate(self.structures), short)

    def _has_features(self) -> bool:
        return self.info.features.form != "none"

    def _batch(self, structures: Optional[list[Structure]] = None, cutoff: Optional[float] = None) -> Batch:
        """With padding, all batches have one shape."""
        structures, cutoff = self.structures if structures is None else structures, cutoff or self._skin
        batch, room = batch_of(structures, cutoff), self._room
        if not self.info.padding:
            return batch
        real = batch.real
        spare = (room.structures - real.structures, room.atoms - real.atoms, room.bonds - real.bonds)
        return batch_of(structures, cutoff, spare)

    def _evaluate(self, structures: list[Structure]) -> Evaluation:
        """Without the spare rows."""
        batch = self._batch(structures)
        result, real = self.adapter.evaluate(batch, self._has_features()), batch.real
        features = None if result.features is None else result.features[: real.atoms]
        return Evaluation(
            result.energies[: real.atoms], features, result.forces[: real.atoms], result.virials[: real.structures]
        )

    def _difference(self, one: Evaluation, other: Evaluation) -> float:
        n, s = len(one.energies), len(one.virials)
        pairs = [(one.energies, other.energies[:n]), (one.forces, other.forces[:n]), (one.virials, other.virials[:s])]
        if one.features is not None and other.features is not None:
            pairs.append((one.features, other.features[:n]))
        return max(_error(a, b) for a, b in pairs)

    def _random_cotangents(self) -> tuple[np.ndarray, np.ndarray]:
        """For the batch of all structures; zero for spare atoms."""
        batch = self._batch()
        n, random = batch.real.atoms, np.random.default_rng(7)
        cotangents = np.zeros((batch.n_atoms, self.info.features.dimension))
        energy = np.zeros(batch.n_atoms)
        cotangents[:n], energy[:n] = random.standard_normal(cotangents[:n].shape), random.standard_normal(n)
        return cotangents, energy

    def _pull_back(self) -> tuple[np.ndarray, np.ndarray]:
        result = self.adapter.pull_back(self._batch(), *self._random_cotangents())
        return result.gradients, result.virials

    def _energy(self, batch: Batch) -> float:
        return float(self.adapter.evaluate(batch, False).energies[: batch.real.atoms].sum(dtype=np.float64))

    def _combination(self, batch: Batch) -> float:
        result = self.adapter.evaluate(batch, True)
        cotangents, energy = self._random_cotangents()
        assert result.features is not None
        return float((cotangents * result.features).sum() + (energy * result.energies).sum())

    def _slope(self, function: Callable[[Batch], float], moved: Callable[[float], list[Structure]]) -> float:
        """Derivative by central differences of fourth order."""
        h = STEP[self.info.precision]
        values = {k: function(self._batch(moved(k * h))) for k in (-2, -1, 1, 2)}
        return (8 * (values[1] - values[-1]) - (values[2] - values[-2])) / (12 * h)

    def _coordinates(self) -> list[tuple[int, int]]:
        total = sum(len(s.species) for s in self.structures)
        return [(int(atom), x) for atom in self._random.choice(total, 3, replace=False) for x in range(3)]

    def _strains(self) -> list[tuple[int, int, int]]:
        return [(0, 0, 0), (1, 0, 1), (1, 2, 2), (2, 1, 2)]

    def _moved(self, atom: int, x: int) -> Callable[[float], list[Structure]]:
        def structures(step: float) -> list[Structure]:
            moved, start = [], 0
            for s in self.structures:
                positions = s.positions.copy()
                if start <= atom < start + len(positions):
                    positions[atom - start, x] += step
                start += len(positions)
                moved.append(Structure(s.species, positions, s.cell, s.periodic))
            return moved

        return structures

    def _strained(self, which: int, x: int, y: int) -> Callable[[float], list[Structure]]:
        def structures(step: float) -> list[Structure]:
            # r → (1 + ε) r, with ε symmetric: half in xy, half in yx.
            strain = np.eye(3)
            strain[x, y] += step / 2
            strain[y, x] += step / 2
            changed = list(self.structures)
            s = changed[which]
            changed[which] = Structure(s.species, s.positions @ strain, s.cell @ strain, s.periodic)
            return changed

        return structures

    def _cluster(self, distance: float, atoms: int) -> Structure:
        grid = distance * np.array([(i, j, k) for i in range(3) for j in range(3) for k in range(3)], dtype=float)
        return Structure(self._species(atoms), grid[:atoms] + self._noise(atoms))

    def _crystal(self, distance: float) -> Structure:
        """Eight atoms in a cell that is not orthogonal."""
        corners = distance * np.array([(i, j, k) for i in range(2) for j in range(2) for k in range(2)], dtype=float)
        cell = 2 * distance * np.array([[1.0, 0, 0], [0.1, 1.05, 0], [-0.05, 0.1, 0.97]])
        return Structure(self._species(8), corners + self._noise(8), cell, (True, True, True))

    def _species(self, atoms: int) -> np.ndarray:
        return self._random.integers(0, len(self.info.elements), atoms).astype(np.int32)

    def _noise(self, atoms: int) -> np.ndarray:
        return 0.2 * self._random.uniform(-1, 1, (atoms, 3))


def _joined(results: list[Evaluation]) -> Evaluation:
    features = [r.features for r in results if r.features is not None]
    return Evaluation(
        np.concatenate([r.energies for r in results]),
        np.concatenate(features) if features else None,
        np.concatenate([r.forces for r in results]),
        np.concatenate([r.virials for r in results]),
    )


def _error(one: Any, other: Any, scale: Optional[float] = None) -> float:
    one, other = np.asarray(one, dtype=float), np.asarray(other, dtype=float)
    if one.size == 0:
        return 0.0
    largest = max(float(np.abs(one).max()), float(np.abs(other).max()), scale or 0.0, 1e-3)
    return float(np.abs(one - other).max() / largest)


def main() -> int:
    """Prints the checks of an adapter; 1 if one is not passed."""
    parser = argparse.ArgumentParser(
        prog="python -m calmwalk.check", description="Checks an adapter on small structures."
    )
    parser.add_argument("adapter", help="a built-in adapter, 'module:ClassName' or '/path/file.py:ClassName'")
    parser.add_argument("model", nargs="?", type=Path)
    parser.add_argument("--options", type=json.loads, default={}, help="options of the adapter, JSON")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--precision", choices=["double", "single"], default="double")
    parser.add_argument("--distance", type=float, default=2.6, help="between neighbours, Å")
    given = parser.parse_args()
    adapter = find_adapter(given.adapter)(
        model=given.model, options=given.options, device=given.device, precision=given.precision, threads=1, cache=None
    )
    check, failed = Check(adapter, distance=given.distance), False
    for name, error in check.all().items():
        passed = error <= check.limit(name)
        failed |= not passed
        print(f"{name:18} {error:9.1e} {'' if passed else f'more than {check.limit(name):.0e}'}")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
