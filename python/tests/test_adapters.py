"""Derivatives, batches, padding, permutation and repeats of every adapter.

Tests of a framework that is missing are left out, but fail if CALMWALK_REQUIRE_ADAPTERS names its adapter ("mace
gracemaker ase").
"""

from __future__ import annotations

import importlib.util
import os
import sys
import tempfile
import unittest
from pathlib import Path
from typing import Any

import numpy as np

from calmwalk.adapter import Adapter
from calmwalk.adapters.radial import Radial
from calmwalk.check import Check
from calmwalk.errors import AdapterError, InputError
from calmwalk.loading import find_adapter
from calmwalk.neighbours import batch_of

from .client import DATA, Client


def need(adapter: str, *modules: str) -> None:
    """Skips a test whose framework is missing, unless it is required."""
    missing = [module for module in modules if importlib.util.find_spec(module) is None]
    if missing and adapter not in os.environ.get("CALMWALK_REQUIRE_ADAPTERS", "").split():
        raise unittest.SkipTest(f"{missing[0]} is not installed")


class Checks(unittest.TestCase):
    def check(self, adapter: Adapter) -> None:
        check = Check(adapter)
        for name, error in check.all().items():
            with self.subTest(name):
                self.assertLessEqual(error, check.limit(name))

    def refused(self, kind: type[Exception], part: str, make: Any) -> None:
        with self.assertRaises(kind) as raised:
            make()
        self.assertIn(part, str(raised.exception))


class RadialModel(Checks):
    def test_checks(self) -> None:
        for model in ("radial-al.json", "radial-al-short.json", "radial-alcu.json"):
            for precision in ("double", "single"):
                with self.subTest(model=model, precision=precision):
                    self.check(Radial(DATA / model, {}, precision=precision))


class MaceModel(Checks):
    folder: tempfile.TemporaryDirectory[str]

    @classmethod
    def setUpClass(cls) -> None:
        need("mace", "torch", "mace")
        from .make_mace import make

        cls.folder = tempfile.TemporaryDirectory()
        cls.addClassCleanup(cls.folder.cleanup)
        cls.model = Path(cls.folder.name) / "mace.model"
        make(str(cls.model))

    def test_checks(self) -> None:
        for precision in ("double", "single"):
            with self.subTest(precision=precision):
                self.check(find_adapter("mace")(self.model, {}, precision=precision))

    def test_results_are_those_of_maces_own_calculator(self) -> None:
        from ase import Atoms
        from mace.calculators import MACECalculator

        adapter = find_adapter("mace")(self.model, {})
        calculator = MACECalculator(model_paths=str(self.model), device="cpu", default_dtype="float64")
        for structure in Check(adapter).structures:
            atoms = Atoms(np.array(["Al", "Cu"])[structure.species], structure.positions)
            atoms.set_cell(structure.cell)
            atoms.pbc = structure.periodic
            result = adapter.evaluate(batch_of([structure], 5.0), True)
            atoms.calc = calculator
            self.assertAlmostEqual(result.energies.sum(), atoms.get_potential_energy(), 9)
            np.testing.assert_allclose(result.forces, atoms.get_forces(), rtol=0, atol=1e-10)
            if all(structure.periodic):
                stress = -result.virials[0] / atoms.get_volume()
                np.testing.assert_allclose(stress, atoms.get_stress(voigt=False), rtol=0, atol=1e-10)
            own = calculator.get_descriptors(atoms, invariants_only=True)
            np.testing.assert_allclose(result.features, own, rtol=0, atol=1e-10)

    def test_errors(self) -> None:
        text = Path(self.folder.name) / "text.model"
        text.write_text("nothing")
        make = find_adapter("mace")
        self.refused(InputError, "text.model: torch cannot read it", lambda: make(text, {}))
        self.refused(
            InputError,
            "option 'head' is 'none', expected one of ['Default']",
            lambda: make(self.model, {"head": "none"}),
        )
        self.refused(InputError, "expected a MACE model", lambda: make(None, {}))

    def test_behind_the_server(self) -> None:
        with Client(sys.executable) as client:
            hello = client.hello("mace", self.model)
            self.assertEqual(hello["features"], {"form": "raw", "dimension": 16, "blocks": [8, 8]}, hello)
            batch = batch_of(Check(find_adapter("mace")(self.model, {})).structures, 5.0)
            kept = client.call("evaluate", batch)
            self.assertEqual(client.receive()["status"], "ok")
            cotangents = np.random.default_rng(1).standard_normal((batch.n_atoms, 16))
            results = []
            for evaluation in (kept, None):
                client.call("pull_back", batch, cotangents=cotangents, kept=evaluation)
                self.assertEqual(client.receive()["status"], "ok")
                results.append(client.results()["gradients"])
            np.testing.assert_allclose(results[0], results[1], rtol=0, atol=1e-12)


class GracemakerModel(Checks):
    @classmethod
    def setUpClass(cls) -> None:
        need("gracemaker", "tensorflow", "tensorpotential")
        from .make_gracemaker import untrained

        folder = tempfile.TemporaryDirectory()
        cls.addClassCleanup(folder.cleanup)
        cls.models = {kind: Path(folder.name) / kind for kind in ("one", "two")}
        for kind, model in cls.models.items():
            model.mkdir()
            untrained(kind, model)

    def adapter(self, kind: str, final: bool, **more: Any) -> Any:
        options = {"artifact": str(self.models[kind] / "gmm_artifacts.npz")} if final else {}
        return find_adapter("gracemaker")(self.models[kind], options, **more)

    def test_checks(self) -> None:
        for kind, final, precision in (("one", False, "single"), ("two", True, "double")):
            with self.subTest(kind=kind, final=final, precision=precision):
                self.check(self.adapter(kind, final, precision=precision))

    def test_final_features_are_the_projected_basis(self) -> None:
        raw, final = self.adapter("two", False), self.adapter("two", True)
        batch = batch_of(Check(raw).structures, 5.0, (1, 1, 1))
        n = batch.real.atoms
        first, again = final.evaluate(batch, True), final.evaluate(batch, True)
        self.assertEqual((first.compiled, again.compiled), (True, False))
        basis = raw.evaluate(batch, True).features[:n]
        hello = final.info.projection
        matrix = np.array(hello["matrix"]).reshape(hello["rows"], hello["columns"])
        parts = np.split(basis, np.cumsum(raw.info.features.blocks)[:-1], axis=1)
        norms = [np.sqrt((part**2).sum(1) + 1e-30) for part in [basis, *parts]]
        expected = np.column_stack([basis / (norms[0][:, None] + 1e-12) @ matrix, *np.log(np.array(norms) + 1e-12)])
        np.testing.assert_allclose(first.features[:n], expected, rtol=0, atol=1e-10)

    def test_errors(self) -> None:
        make, model = find_adapter("gracemaker"), self.models["one"]
        self.refused(InputError, "has no model.yaml", lambda: make(model.parent, {}))
        self.refused(
            InputError, "has no checkpoint 'best'; found ['checkpoint']", lambda: make(model, {"checkpoint": "best"})
        )
        two = str(self.models["two"] / "gmm_artifacts.npz")
        self.refused(InputError, "rows, the model's basis", lambda: make(model, {"artifact": two}))
        yaml = str(model / "model.yaml")
        self.refused(InputError, "not an .npz file", lambda: make(model, {"artifact": yaml}))


class AseCalculators(Checks):
    @classmethod
    def setUpClass(cls) -> None:
        need("ase", "ase")

    def test_checks(self) -> None:
        options = {"calculator": "ase.calculators.emt:EMT", "elements": ["Al", "Cu"]}
        for numerical in (False, True):
            with self.subTest(numerical_stress=numerical):
                self.check(find_adapter("ase")(None, {**options, "numerical_stress": numerical}))

    def test_a_file_that_defines_a_calculator(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "mine.py"
            lines = [
                "from ase.calculators.lj import LennardJones",
                "calculator = LennardJones(sigma=2.3, rc=6, smooth=True)",
            ]
            file.write_text("\n".join(lines))
            adapter = find_adapter("ase")(file, {"elements": ["Al"]})
            self.assertEqual(adapter.info.features.dimension, 0)
            self.check(adapter)

    def test_errors(self) -> None:
        make = find_adapter("ase")
        self.refused(InputError, "no model and no option 'calculator'", lambda: make(None, {}))
        self.refused(InputError, "expected 'module:name'", lambda: make(None, {"calculator": "EMT"}))
        self.refused(InputError, "has no 'Emt'", lambda: make(None, {"calculator": "ase.calculators.emt:Emt"}))
        self.refused(ModuleNotFoundError, "no_module", lambda: make(None, {"calculator": "no_module:Emt"}))
        options = {"calculator": "ase.calculators.emt:EMT", "elements": ["Aluminium"]}
        self.refused(InputError, "'Aluminium', expected chemical symbols", lambda: make(None, options))
        adapter = make(None, {"calculator": "ase.calculators.emt:EMT"})
        batch = batch_of(Check(Radial(DATA / "radial-al.json", {})).structures, 0.1)
        self.refused(AdapterError, "no features", lambda: adapter.pull_back(batch, np.zeros((batch.n_atoms, 0))))


if __name__ == "__main__":
    unittest.main()
