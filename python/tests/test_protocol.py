"""The server in a process of its own: answers, results, faults and every kind of error."""

from __future__ import annotations

import tempfile
import unittest
from pathlib import Path
from typing import Any

import numpy as np

from calmwalk.adapters.radial import Radial
from calmwalk.arenas import _INPUTS, Arenas
from calmwalk.check import Check
from calmwalk.neighbours import Structure, batch_of

from .client import DATA, Client

MODEL = DATA / "radial-alcu.json"


def small_batch(spare: tuple[int, int, int] = (0, 0, 0)):  # type: ignore[no-untyped-def]
    """Three structures of Al and Cu."""
    return batch_of(Check(Radial(MODEL, {})).structures, 6.0, spare)


class RoundTrip(unittest.TestCase):
    def setUp(self) -> None:
        self.client = Client()
        self.addCleanup(self.client.__exit__)
        self.hello = self.client.hello("radial", MODEL)

    def test_hello_says_what_the_model_is(self) -> None:
        hello = self.hello
        self.assertEqual((hello["status"], hello["protocol"], hello["adapter"]), ("ok", 1, "radial"))
        self.assertEqual(hello["elements"], ["Al", "Cu"])
        self.assertEqual(hello["cutoffs"], [[5.5, 5.5], [5.5, 5.5]])
        self.assertEqual(hello["features"], {"form": "raw", "dimension": 14, "blocks": [8, 6]})
        self.assertRegex(hello["identity"], "^[0-9a-f]{64}$")
        self.assertIs(hello["padding"], False)
        self.assertIs(hello["evaluates_without_forces"], True)
        self.assertLessEqual({"python", "numpy"}, set(hello["versions"]))

    def test_results_are_those_of_the_adapter(self) -> None:
        adapter = Radial(MODEL, {})
        for spare in ((0, 0, 0), (1, 2, 5)):
            batch = small_batch(spare)
            expected = adapter.evaluate(batch, True)
            identifier = self.client.call("evaluate", batch)
            answer = self.client.receive()
            self.assertEqual((answer["status"], answer["id"], answer["compiled"]), ("ok", identifier, False))
            self.assertGreater(answer["seconds"], 0)
            for name, result in self.client.results().items():
                np.testing.assert_array_equal(result, getattr(expected, name))

    def test_pull_back_with_and_without_what_was_kept(self) -> None:
        batch, random = small_batch(), np.random.default_rng(3)
        cotangents, energy = random.standard_normal((batch.n_atoms, 14)), random.standard_normal(batch.n_atoms)
        adapter = Radial(MODEL, {})
        for weights in (None, energy):
            expected = adapter.pull_back(small_batch(), cotangents, weights)
            evaluation = self.client.call("evaluate", batch)
            self.client.receive()
            for kept in (evaluation, None, 999):
                self.client.call("pull_back", batch, cotangents=cotangents, energy=weights, kept=kept)
                self.assertEqual(self.client.receive()["status"], "ok")
                results = self.client.results()
                np.testing.assert_array_equal(results["gradients"], expected.gradients)
                np.testing.assert_array_equal(results["gradient_virials"], expected.virials)

    def test_forces_may_come_with_the_pull_back(self) -> None:
        """Energies and features without forces, then one gradient of Σ E + Σ z̄·z from what was kept."""
        batch, random = small_batch(), np.random.default_rng(3)
        cotangents, ones = random.standard_normal((batch.n_atoms, 14)), np.ones(batch.n_atoms)
        adapter = Radial(MODEL, {})
        plain, gradients = adapter.evaluate(small_batch(), True), adapter.pull_back(small_batch(), cotangents)
        evaluation = self.client.call("evaluate", batch, forces=False)
        self.assertEqual(self.client.receive()["status"], "ok")
        found = self.client.results()
        self.assertEqual(set(found), {"energies", "features"})
        np.testing.assert_array_equal(found["energies"], plain.energies)
        np.testing.assert_array_equal(found["features"], plain.features)
        self.client.call("pull_back", batch, cotangents=cotangents, energy=ones, kept=evaluation)
        self.assertEqual(self.client.receive()["status"], "ok")
        found = self.client.results()
        np.testing.assert_allclose(found["gradients"], gradients.gradients - plain.forces, atol=1e-12)
        np.testing.assert_allclose(found["gradient_virials"], gradients.virials - plain.virials, atol=1e-12)

    def test_calls_in_flight_are_answered_in_order(self) -> None:
        batch = small_batch()
        sent = [self.client.call("evaluate", batch, arena=arena) for arena in (0, 1, 2)]
        self.assertEqual([self.client.receive()["id"] for _ in sent], sent)
        np.testing.assert_array_equal(self.client.results(0)["forces"], self.client.results(2)["forces"])

    def test_an_arena_that_grows_is_mapped_again(self) -> None:
        structures = Check(Radial(MODEL, {})).structures
        for count in (1, 3):
            self.client.call("evaluate", batch_of(structures[:count], 6.0), topology=count)
            self.assertEqual(self.client.receive()["status"], "ok")
            self.assertTrue(np.isfinite(self.client.results()["forces"]).all())

    def test_atoms_without_bonds(self) -> None:
        self.client.call("evaluate", batch_of([Structure(np.zeros(1, np.int32), np.zeros((1, 3)))], 6.0))
        self.assertEqual(self.client.receive()["status"], "ok")
        np.testing.assert_array_equal(self.client.results()["energies"], [0.0])

    def test_the_end_of_input_ends_the_server(self) -> None:
        with Client() as other:
            other.process.stdin.close()
            self.assertEqual(other.process.wait(10), 0)


class Views(unittest.TestCase):
    def test_they_are_made_once_for_a_layout(self) -> None:
        with tempfile.NamedTemporaryFile() as file:
            file.truncate(1 << 16)
            sizes = {"structures": 1, "atoms": 2, "bonds": 2}
            message = {"id": 1, "arena": 0, "path": file.name, "bytes": 1 << 16, **sizes, "real": sizes, "topology": 1}
            arenas = Arenas()

            def read(first: int, **more: Any) -> np.ndarray:
                names = [*_INPUTS, "energies", "forces"]
                offsets = {name: first + 256 * number for number, name in enumerate(names)}
                call = {**message, "sections": offsets, **more}
                arenas.read(call, 0, ["forces"])
                return arenas.read(call, 0, ["energies"]).arrays["energies"]

            energies = read(0)
            self.assertIs(read(0), energies)
            energies[:] = 7.0
            np.testing.assert_array_equal(read(64), [0.0, 0.0])
            np.testing.assert_array_equal(read(0), [7.0, 7.0])
            self.assertEqual(read(0, atoms=3).shape, (3,))


class Errors(unittest.TestCase):
    def refused(self, client: Client, answer: dict[str, Any], kind: str, *parts: str) -> None:
        self.assertEqual((answer["status"], answer["kind"]), ("error", kind), answer)
        self.assertNotIn("\n", answer["message"])
        for part in parts:
            self.assertIn(part, answer["message"])
        self.assertIsNone(client.process.poll(), "the server continues")

    def test_of_hello(self) -> None:
        with Client() as client, tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "broken.py"
            file.write_text("import no_such_module\n")
            empty = Path(folder) / "empty.py"
            empty.write_text("")
            nonsense = Path(folder) / "model.json"
            nonsense.write_text('{"elements": ["Al"]}')
            cases: list[tuple[dict[str, Any], str, list[str]]] = [
                (dict(adapter="radial", model=MODEL, protocol=2), "input", ["protocol 2, this package 1"]),
                (dict(adapter="nonsense", model=None), "input", ["adapter nonsense, hello:", "gracemaker, mace"]),
                (dict(adapter=f"{folder}/none.py:Model", model=None), "input", ["none.py does not exist"]),
                (dict(adapter=f"{empty}:Model", model=None), "input", ["empty.py has no 'Model'"]),
                (dict(adapter=f"{file}:Model", model=None), "import", ["'no_such_module' is missing", "environment /"]),
                (dict(adapter="radial", model=None), "input", ["adapter radial, hello: no model is given"]),
                (dict(adapter="radial", model=folder + "/none"), "input", ["none does not exist"]),
                (dict(adapter="radial", model=file), "input", ["broken.py: not a file of JSON"]),
                (dict(adapter="radial", model=nonsense), "input", ["model.json: 'blocks' is None, expected list"]),
                (dict(adapter="radial", model=MODEL, options={"a": 1}), "input", ["unknown option 'a'"]),
                (dict(adapter="radial", model=MODEL, precision="half"), "input", ["'half'", "'double' or 'single'"]),
            ]
            for arguments, kind, parts in cases:
                self.refused(client, client.hello(**arguments), kind, *parts)
            self.assertEqual(client.hello("radial", MODEL)["status"], "ok")
            self.refused(client, client.hello("radial", MODEL), "input", "a second hello")

    def test_of_messages(self) -> None:
        with Client() as client:
            self.refused(client, client.ask(b"{nonsense"), "input", "expected a line of JSON")
            self.refused(client, client.ask(b"[1]"), "input", "an object with the key 'call'")
            self.refused(client, client.ask({"call": "evaluate", "id": 4}), "input", "a call before hello")
            client.hello("radial", MODEL)
            self.refused(client, client.ask({"call": "jump", "id": 5}), "input", "the call is 'jump'")
            answer = client.ask({"call": "evaluate", "id": 6, "arena": 0, "path": "/dev/shm/no-arena", "bytes": 64})
            self.refused(client, answer, "input", "cannot open the arena /dev/shm/no-arena")
            self.assertEqual(answer["id"], 6)

    def test_of_sections(self) -> None:
        with Client() as client, tempfile.NamedTemporaryFile() as file:
            file.truncate(6400)
            client.hello("radial", MODEL)
            names = [*_INPUTS, "energies", "forces", "virials"]
            message: dict[str, Any] = dict(call="evaluate", id=1, arena=0, path=file.name, bytes=6400)
            message.update(structures=1, atoms=2, bonds=2, real=dict(structures=1, atoms=2, bonds=2), topology=1)
            message.update(features=False, sections={name: 128 * i for i, name in enumerate(names)})
            changes: list[tuple[dict[str, Any], str]] = [
                (dict(bytes=12800), "has 6400 bytes, expected 12800"),
                (dict(atoms=-2), "expected no negative number"),
                (dict(atoms="2"), "atoms is '2', expected int"),
                (dict(real=dict(structures=1, atoms=3, bonds=2)), "more than the shape [1, 2, 2]"),
                (dict(sections={**message["sections"], "bonds": 65}), "section bonds is 65, expected a multiple of 64"),
                (dict(sections={"species": 0}), "section structure_of_atom is None"),
                (dict(sections={**message["sections"], "cells": 6400}), "section cells ends at byte 6472"),
            ]
            for change, part in changes:
                self.refused(client, client.ask({**message, **change}), "input", "adapter radial, evaluate:", part)

    def test_of_adapters(self) -> None:
        kinds = {
            "nan": None,
            "print": None,
            "shape": ("exception", "evaluate: forces has the shape (18, 3), expected (19, 3)"),
            "type": ("exception", "forces has the type int64, expected floating point"),
            "exception": ("exception", "adapter simulated, evaluate: ZeroDivisionError: a fault that was asked for"),
            "memory": ("memory", "out of memory (MemoryError"),
            "import": ("import", "'calmwalk_missing_module' is missing"),
        }
        with tempfile.TemporaryDirectory() as folder, Client() as client:
            control = Path(folder) / "control"
            client.hello("simulated", MODEL, options={"control": str(control), "memory_above": 2})
            batch = small_batch()
            client.call("evaluate", batch)
            self.refused(client, client.receive(), "memory", "3 structures in a batch, room for 2")
            control.write_text("\n".join(["memory_above 4", *kinds]))
            for fault, error in kinds.items():
                client.call("evaluate", batch)
                answer = client.receive()
                if error is None:
                    self.assertEqual(answer["status"], "ok", fault)
                    self.assertEqual(np.isnan(client.results()["forces"]).sum(), int(fault == "nan"))
                else:
                    self.refused(client, answer, *error)
                    self.assertIn("Traceback", answer["traceback"])
            client.call("evaluate", batch)
            self.assertEqual(client.receive()["status"], "ok")
            self.assertFalse(control.exists())

    def test_of_adapters_of_ones_own(self) -> None:
        with tempfile.TemporaryDirectory() as folder, Client() as client:
            file = Path(folder) / "wrong.py"
            file.write_text(
                "import sys\n"
                "from calmwalk.adapters.radial import Radial\n"
                "class OutOfMemoryError(RuntimeError): pass\n"
                "class Wrong(Radial):\n"
                "    evaluate_without_forces = None\n"
                "    def evaluate(self, batch, features):\n"
                "        result = super().evaluate(batch, features)\n"
                "        result.energies = list(result.energies)\n"
                "        return result\n"
                "    def pull_back(self, batch, *cotangents):\n"
                "        if batch.n_structures == 1:\n"
                "            sys.exit('no way')\n"
                "        raise OutOfMemoryError('CUDA out of memory.\\nTried to allocate 2.00 GiB')\n"
            )
            hello = client.hello(f"{file}:Wrong", MODEL)
            self.assertEqual((hello["status"], hello["evaluates_without_forces"]), ("ok", False))
            batch = small_batch()
            client.call("evaluate", batch)
            self.refused(client, client.receive(), "exception", "evaluate: energies is a list, expected a numpy array")
            client.call("evaluate", batch, forces=False)  # it computes them all the same
            self.refused(client, client.receive(), "exception", "evaluate: energies is a list")
            zeros = np.zeros((batch.n_atoms, 14))
            client.call("pull_back", batch, cotangents=zeros)
            self.refused(client, client.receive(), "memory", "CUDA out of memory. Tried to allocate")
            single = batch_of(Check(Radial(MODEL, {})).structures[:1], 6.0)
            client.call("pull_back", single, cotangents=np.zeros((single.n_atoms, 14)))
            self.refused(client, client.receive(), "exception", "pull_back: SystemExit: no way")


class SimulatedDevice(unittest.TestCase):
    def test_time_of_calls_and_new_shapes(self) -> None:
        options = {"base_seconds": 0.05, "seconds_per_structure": 0.01, "compile_seconds": 0.1}
        with Client() as client:
            hello = client.hello("simulated", MODEL, options={**options, "max_structures": 32})
            self.assertEqual((hello["padding"], hello["max_structures"]), (True, 32))
            batch = small_batch((1, 1, 1))
            for compiled, seconds in ((True, 0.18), (False, 0.08)):
                client.call("evaluate", batch)
                answer = client.receive()
                self.assertEqual(answer["compiled"], compiled)
                self.assertGreaterEqual(answer["seconds"], seconds)
                self.assertLess(answer["seconds"], seconds + 1)

    def test_exit_at_a_call(self) -> None:
        with Client() as client:
            client.hello("simulated", MODEL, options={"fault": "exit", "fault_call": "pull_back", "fault_at": 2})
            batch = small_batch()
            zeros = np.zeros((batch.n_atoms, 14))
            client.call("pull_back", batch, cotangents=zeros)
            self.assertEqual(client.receive()["status"], "ok")
            client.call("pull_back", batch, cotangents=zeros)
            self.assertEqual(client.process.stdout.readline(), b"")
            self.assertEqual(client.process.wait(10), 3)

    def test_models_that_are_wrong_on_purpose(self) -> None:
        from calmwalk.adapters.simulated import Simulated

        wrong = {
            "forces": {"bend": {"forces": 1.16}},
            "virials": {"bend": {"virials": 1.16}},
            "gradients": {"bend": {"gradients": 0.9}},
            "gradient_virials": {"bend": {"gradient_virials": 0.9}},
            "repeat": {"noise": 1e-6},
            "permutation": {"order": 1e-3},
            "batch": {"crowd": 1e-3},
        }
        for name, options in wrong.items():
            check = Check(Simulated(MODEL, options))
            self.assertGreater(getattr(check, name)(), check.limit(name), name)


if __name__ == "__main__":
    unittest.main()
