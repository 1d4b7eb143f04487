"""Reading of campaigns, against `calmwalk export` of a real one.

    PYTHONPATH=python python -m unittest discover -s python/tests -p 'test_campaign*'

Needs a calmwalk binary (`CALMWALK_BINARY`, `target` or the path), numpy and ase; parts need pandas, pyarrow or, with
`CALMWALK_POSTGRES=$(.ci/postgres start)`, psycopg.
"""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import sqlite3
import tempfile
import unittest
from pathlib import Path

import numpy as np
import small_campaign

import calmwalk
from calmwalk.campaign import Campaign
from calmwalk.records import Candidate
from calmwalk.store import APPLICATION, NEWEST_SCHEMA, OLDEST_SCHEMA
from calmwalk.store_errors import DamagedError, MissingCampaign, SchemaError, StoreError


def _has(package: str) -> bool:
    return importlib.util.find_spec(package) is not None


_POSTGRES = os.environ.get("CALMWALK_POSTGRES")
# What frames have in addition to those of an export.
_OWN_INFO = {"decision", "fate", "reason", "model_energy", "model_virial"}
_OWN_ARRAYS = {"model_forces", "forces"}


@unittest.skipUnless(
    small_campaign.program(), "there is no calmwalk binary: build one, or set CALMWALK_BINARY"
)
@unittest.skipUnless(_has("ase"), "needs ase")
class CampaignCase(unittest.TestCase):
    """Tests of one campaign, which is run once for each class and not changed."""

    directory: Path
    location: str
    campaign: Campaign

    @classmethod
    def setUpClass(cls) -> None:
        cls.directory = Path(cls.enterClassContext(tempfile.TemporaryDirectory()))
        cls.location = cls.place()
        cls.campaign = cls.enterClassContext(calmwalk.open(cls.location))

    @classmethod
    def place(cls) -> str:
        return small_campaign.make(cls.directory)


class ReadingTests(CampaignCase):
    def test_the_data_set_is_that_of_an_export_number_by_number(self) -> None:
        from ase.io import read

        file = self.directory / "export.extxyz"
        small_campaign.run("export", self.location, "--output", str(file), "--control", "--imported")
        expected, found = read(file, index=":"), list(self.campaign.dataset(control=True, imported=True))
        self.assertEqual(len(found), len(expected))
        self.assertGreater(len(found), 5)
        for one, other in zip(found, expected, strict=True):
            self.assert_equal_frames(one, other)
        self.assertEqual(found[-1].info["origin"], "imported")
        biased = [frame for frame in found if frame.info["origin"] == "biased"]
        self.assertEqual(len(list(self.campaign.dataset())), len(biased))

    def assert_equal_frames(self, found, expected) -> None:
        self.assertEqual({k: v for k, v in found.info.items() if k not in _OWN_INFO}, expected.info)
        for name in ("numbers", "positions", "cell", "pbc"):
            np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), name)
        arrays = (set(frame.arrays) - _OWN_ARRAYS for frame in (found, expected))
        self.assertEqual(*arrays)
        for name in set(expected.arrays) - {"forces"}:
            np.testing.assert_array_equal(found.arrays[name], expected.arrays[name], name)
        self.assertEqual(set(found.calc.results), set(expected.calc.results))
        for name, value in expected.calc.results.items():
            np.testing.assert_array_equal(found.calc.results[name], value, name)

    def test_a_candidate_agrees_with_its_row_and_its_atoms_grades(self) -> None:
        rows = {row["id"]: row for row in self.campaign.rows("SELECT * FROM candidate")}
        seen = 0
        for candidate in self.campaign.candidates(features=True):
            row, seen = rows[candidate.id], seen + 1
            self.assertEqual(candidate.energy, row["energy"])
            self.assertEqual(candidate.temperature, row["temperature"])
            self.assertEqual(candidate.relative_volume, row["relative_volume"])
            self.assertEqual(len(candidate.structure.numbers), row["atoms"])
            grades = (candidate.walker_gamma, candidate.selector_gamma, candidate.original_gamma)
            for name, gamma in zip(("walker", "selector", "original"), grades, strict=True):
                self.assertEqual(gamma.max(), row[f"{name}_gamma"])
                self.assertEqual((gamma > 1).sum(), row[f"{name}_above"])
            self.assertEqual(candidate.features.shape[0], row["atoms"])
        self.assertEqual(seen, len(rows))

    def test_grades_follow_from_features_and_the_mixture(self) -> None:
        """γ = min over components of √(δᵀSδ) / θ, under the newest mixture: compared with that of the last update."""
        last = list(self.campaign.mixture_updates())[-1]
        candidate = self.campaign.candidate(last.candidate)
        gammas = []
        for component in self.campaign.components():
            delta = candidate.features - component.centroid
            squares = np.einsum("ni,ij,nj->n", delta, component.inverse, delta)
            gammas.append(np.sqrt(squares) / component.threshold)
            np.testing.assert_allclose(
                np.linalg.inv(component.covariance + 1e-6 * np.eye(len(delta[0]))),
                component.inverse,
                rtol=1e-6,
                atol=1e-6,
            )
        found = np.min(gammas, axis=0).max()
        self.assertAlmostEqual(found, last.detail["update"]["gamma_max_after"], delta=1e-8)

    def test_traces_are_those_of_the_program_number_by_number(self) -> None:
        points = 0
        for walk in self.campaign.walks():
            text = small_campaign.run("walks", self.location, "trace", str(walk.walk)).splitlines()
            trace = self.campaign.walk_trace(walk.walk)
            self.assertEqual(list(trace), text[0].split(","))
            rows = [[float(cell or "nan") for cell in line.split(",")] for line in text[1:]]
            found = np.array(list(trace.values())).T
            np.testing.assert_array_equal(found, np.array(rows).reshape(found.shape))
            self.assertLessEqual(trace["step"].max(initial=0), walk.step)
            points += len(rows)
        self.assertGreater(points, 8)
        with self.assertRaisesRegex(KeyError, "has no walk 999"):
            self.campaign.walk_trace(999)
        if _has("pandas"):
            frame = self.campaign.pandas("traces")
            self.assertEqual(len(frame), points)
            self.assertTrue((self.campaign.pandas("traces", walk=1)["walk"] == 1).all())

    def test_filters_select_what_they_say(self) -> None:
        everything = list(self.campaign.candidates())
        some = everything[0]
        kept: list[tuple[dict, object]] = [
            ({"fate": "accepted"}, lambda c: c.fate == "accepted"),
            ({"fate": "declined"}, lambda c: c.fate == "declined"),
            ({"origin": "control"}, lambda c: c.origin == "control"),
            ({"walk": some.walk}, lambda c: c.walk == some.walk),
            ({"walk": []}, lambda c: False),
            ({"walk": [0, 1, 2]}, lambda c: c.walk <= 2),
            ({"seed_structure": "vacancy"}, lambda c: c.seed_structure_name == "vacancy"),
            ({"seed_structure": [some.seed_structure]}, lambda c: c.seed_structure == some.seed_structure),
            ({"min_gamma": 1.5}, lambda c: c.original_gamma.max() >= 1.5),
            ({"max_gamma": 1.5, "labelled": True}, lambda c: c.original_gamma.max() <= 1.5 and c.label),
            ({"labelled": False}, lambda c: c.label is None),
            ({"element": "Al"}, lambda c: True),
            ({"element": "A"}, lambda c: False),
            ({"temperature": 700.0, "potential_version": 0}, lambda c: True),
            ({"temperature": 701.0}, lambda c: False),
            ({"after": some.decision, "limit": 3}, lambda c: c in everything[1:4]),
            ({"before": everything[2].decision}, lambda c: c.decision < everything[2].decision),
        ]
        for filters, condition in kept:
            with self.subTest(filters=filters):
                found = [c.id for c in self.campaign.candidates(**filters)]
                self.assertEqual(found, [c.id for c in everything if _in(condition, c, everything)])
        with self.assertRaisesRegex(TypeError, "unknown filter 'fat', expected one of after, before"):
            self.campaign.candidates(fat="accepted")
        with self.assertRaisesRegex(ValueError, "no seed structure 'bcc'"):
            list(self.campaign.candidates(seed_structure="bcc"))
        with self.assertRaisesRegex(StoreError, "no label protocol 'dft', the campaign has"):
            list(self.campaign.candidates(protocol="dft"))

    def test_walks_labels_and_versions(self) -> None:
        walks = list(self.campaign.walks())
        self.assertEqual([walk.walk for walk in walks], list(range(len(walks))))
        self.assertEqual({walk.seed_structure_name for walk in walks}, {"fcc-100", "vacancy"})
        self.assertEqual(walks[0].conditions.volume_ramp, (1.0, 1.25))
        self.assertEqual({walk.partner for walk in walks if walk.origin == "control"}, {0, 1})
        labels = list(self.campaign.labels())
        self.assertEqual(labels[-1].file and Path(labels[-1].file).name, "imported.extxyz")
        np.testing.assert_array_equal(
            labels[-1].stress, [[0.01, 0.001, 0.002], [0.001, 0.02, 0.003], [0.002, 0.003, 0.03]]
        )
        self.assertEqual(list(self.campaign.structure(labels[-1].structure).numbers), [13, 13])
        self.assertEqual(self.campaign.versions(), [])
        self.assertEqual(self.campaign.configuration["campaign"]["mode"], self.campaign.mode)
        self.assertEqual(len(list(self.campaign.seed_structures())), 2)

    def test_a_mixture_of_any_version(self) -> None:
        program = small_campaign.program()
        versions = [update.mixture_version for update in self.campaign.mixture_updates()]
        self.assertEqual(versions, list(range(1, len(versions) + 1)))
        newest, first = self.campaign.mixture(program=program), self.campaign.mixture(0, program=program)
        changed = [name for name in first if not np.array_equal(first[name], newest[name])]
        self.assertTrue(changed)
        with self.assertRaisesRegex(StoreError, "calm export failed: .*version"):
            self.campaign.mixture(10_000, program=program)
        with self.assertRaisesRegex(StoreError, "'no-such-program', which is not on the path"):
            self.campaign.mixture(program="no-such-program")

    @unittest.skipUnless(_has("pandas") and _has("pyarrow"), "needs pandas and pyarrow")
    def test_tables_for_pandas_and_arrow_agree(self) -> None:
        candidates = list(self.campaign.candidates(fate="accepted"))
        table = self.campaign.pandas("candidates", fate="accepted")
        self.assertEqual(list(table["id"]), [candidate.id for candidate in candidates])
        np.testing.assert_array_equal(table["label_energy"], [c.label.energy for c in candidates])
        forces = [np.linalg.norm(c.label.forces, axis=1).max() for c in candidates]
        np.testing.assert_array_equal(table["label_max_force"], forces)
        for name in ("candidates", "labels", "walks", "mixtures", "versions", "decisions"):
            with self.subTest(table=name):
                arrow = self.campaign.arrow(name)
                self.assertEqual(list(self.campaign.pandas(name).columns), arrow.column_names)
                batches = list(self.campaign.arrow_batches(name, size=3))
                self.assertEqual(sum(batch.num_rows for batch in batches), arrow.num_rows)
        with self.assertRaisesRegex(KeyError, "no table 'walk', expected one of candidates"):
            self.campaign.pandas("walk")

    def test_an_ase_database(self) -> None:
        from ase.db import connect

        path = self.directory / "candidates.db"
        count = self.campaign.to_ase_db(path, fate="accepted", labelled=True)
        expected = list(self.campaign.atoms(fate="accepted", labelled=True))
        with connect(path) as database:
            self.assertEqual((database.count(), count), (len(expected), len(expected)))
            self.assertEqual(database.count("walk=0"), sum(frame.info["walk"] == 0 for frame in expected))
            for row, frame in zip(database.select(sort="id"), expected, strict=True):
                self.assertEqual(row.energy, frame.get_potential_energy())
                np.testing.assert_array_equal(row.forces, frame.get_forces())
                np.testing.assert_array_equal(row.data["gamma"], frame.arrays["gamma"])
                self.assertEqual(row.candidate_id, frame.info["candidate_id"])
        with self.assertRaisesRegex(FileExistsError, "exists already"):
            self.campaign.to_ase_db(path)
        broken = self.directory / "broken.db"
        with self.assertRaises(ValueError):
            self.campaign.to_ase_db(broken, seed_structure="bcc")
        self.assertFalse(broken.exists())

    def test_a_campaign_is_found_as_on_the_command_line(self) -> None:
        if _is_server(self.location):
            self.skipTest("the campaign is on a server")
        for place in (self.directory, Path(self.location), Path(self.location) / "campaign.sqlite"):
            with calmwalk.open(place) as found:
                self.assertEqual(found.id, self.campaign.id)


def _is_server(location: str) -> bool:
    return location.startswith("postgres")


def _in(condition, candidate: Candidate, everything: list[Candidate]) -> bool:
    """Candidates hold arrays, which `in` cannot compare."""
    try:
        return bool(condition(candidate))
    except ValueError:
        return candidate.id in [other.id for other in everything[1:4]]


@unittest.skipUnless(
    _POSTGRES and _has("psycopg"), "needs psycopg, and CALMWALK_POSTGRES=$(.ci/postgres start)"
)
class PostgresTests(ReadingTests):
    @classmethod
    def place(cls) -> str:
        return small_campaign.make(cls.directory, f"{_POSTGRES}?schema=python_{os.getpid()}")

    def test_nothing_can_be_written(self) -> None:
        with self.assertRaisesRegex(StoreError, "read-only transaction"):
            self.campaign.rows("DELETE FROM walk")

    def test_a_schema_without_a_campaign(self) -> None:
        with self.assertRaisesRegex(MissingCampaign, "the schema 'nothing_here' has no tables"):
            calmwalk.open(f"{_POSTGRES}?schema=nothing_here")


class LocationTests(unittest.TestCase):
    def test_a_password_is_not_shown_and_other_hosts_need_protection(self) -> None:
        from calmwalk.store import _without_password, _without_schema

        shown = _without_password("postgres://anna:s3cret@head:5433/lab?password=s3cret&schema=alloy")
        self.assertEqual(shown, "postgres://anna@head:5433/lab?schema=alloy")
        with self.assertRaisesRegex(StoreError, "'head' is another host.*sslmode=verify-full") as caught:
            _without_schema("postgres://anna:s3cret@head/lab")
        self.assertNotIn("s3cret", str(caught.exception))
        for local in ("localhost", "127.0.0.1:5433", "[::1]"):
            self.assertEqual(_without_schema(f"postgres://{local}/lab?schema=alloy")[1], "alloy")
        url = "postgres://head/lab?sslmode=require&schema=alloy"
        self.assertEqual(_without_schema(url), ("postgres://head/lab?sslmode=require", "alloy"))

    def test_missing_directories(self) -> None:
        with tempfile.TemporaryDirectory() as directory:
            with self.assertRaisesRegex(MissingCampaign, "nowhere: the directory does not exist"):
                calmwalk.open(Path(directory) / "nowhere")
            with self.assertRaisesRegex(MissingCampaign, "it has no campaign.sqlite"):
                calmwalk.open(directory)


class DamageTests(CampaignCase):
    def setUp(self) -> None:
        self.copy = Path(self.enterContext(tempfile.TemporaryDirectory()))
        shutil.copy(Path(self.location) / "campaign.sqlite", self.copy)
        self.file = self.copy / "campaign.sqlite"

    def change(self, *statements: str) -> None:
        connection = sqlite3.connect(self.file)
        connection.create_function("flip", 2, _flipped)
        with connection:
            for statement in statements:
                connection.execute(statement)
        connection.close()

    def test_other_schemas_are_refused_with_both_versions(self) -> None:
        for found, message in [
            (
                NEWEST_SCHEMA + 1,
                f"schema version {NEWEST_SCHEMA + 1}, and this package reads versions .*newer calmwalk",
            ),
            (
                OLDEST_SCHEMA - 1,
                f"schema version {OLDEST_SCHEMA - 1}, and .* {OLDEST_SCHEMA} to {NEWEST_SCHEMA}: any",
            ),
        ]:
            self.change(f"PRAGMA user_version = {found}")
            with self.assertRaisesRegex(SchemaError, message):
                calmwalk.open(self.copy)
        self.change(f"PRAGMA user_version = {NEWEST_SCHEMA}", "PRAGMA application_id = 7")
        with self.assertRaisesRegex(SchemaError, f"application id 0x7, expected {APPLICATION:#x}"):
            calmwalk.open(self.copy)
        self.file.write_text("no database at all")
        with self.assertRaisesRegex(SchemaError, "is not an SQLite database: it begins with b'no database"):
            calmwalk.open(self.copy)

    def test_a_flipped_bit_is_detected_wherever_it_is(self) -> None:
        name = next(self.campaign.candidates()).id
        its_decision = f"(SELECT decision FROM candidate WHERE id = '{name}')"
        one = f"WHERE decision = {its_decision}"
        another = f"(SELECT max(block) FROM candidate_data WHERE decision <> {its_decision})"
        damages = {
            f"UPDATE candidate_data SET block = flip(block, 300) {one}": "damaged candidate block: checksum",
            f"UPDATE candidate_data SET block = flip(block, 3) {one}": "not a candidate block",
            f"UPDATE candidate_data SET block = flip(block, 9) {one}": "candidate block of version",
            f"UPDATE candidate_data SET block = flip(block, 25) {one}": "its header says",
            f"UPDATE candidate_data SET block = substr(block, 1, 100) {one}": "too short: 100 bytes",
            f"UPDATE candidate_data SET block = {another} {one}": "its block is that of",
            f"UPDATE candidate_data SET features = flip(features, 70) {one}": "the features of the candidate",
            f"UPDATE candidate_data SET original_grades = flip(original_grades, 9) {one}": "the original grades of",
            f"UPDATE candidate SET energy = energy + 1e-9 {one}": "candidate [0-9]+: its content has the checksum",
            f"UPDATE candidate SET checksum = NULL {one}": "its checksum is missing",
            "UPDATE label SET forces = flip(forces, 9) WHERE number = 1": "label 1: its content",
            "UPDATE decision SET detail = detail || ' '": "decision [0-9]+: its content",
            "UPDATE seed_structure SET name = 'x' WHERE seed = 0": "seed structure 0: its content",
            "UPDATE walk_conditions SET conditions = conditions || ' '": "walk conditions 0: its content",
        }
        for statement, message in damages.items():
            with self.subTest(statement=statement):
                shutil.copy(Path(self.location) / "campaign.sqlite", self.copy)
                self.change(statement)
                with calmwalk.open(self.copy) as damaged, self.assertRaisesRegex(DamagedError, message):
                    for _ in damaged.candidates(features=True):
                        pass

    def test_a_damaged_walk_component_or_structure(self) -> None:
        self.change(
            "UPDATE walk SET rollbacks = rollbacks + 1 WHERE walk = 1",
            "UPDATE walk_trace SET data = flip(data, 40)",
            "UPDATE component SET bytes = flip(bytes, 40)",
            "UPDATE structure SET data = flip(data, 40)",
        )
        with calmwalk.open(self.copy) as damaged:
            with self.assertRaisesRegex(DamagedError, "walk 1: its content"):
                list(damaged.walks())
            with self.assertRaisesRegex(DamagedError, "walk trace 1: its content"):
                damaged.walk_trace(1)
            with self.assertRaisesRegex(DamagedError, "component 0: its content"):
                list(damaged.components())
            with self.assertRaisesRegex(DamagedError, "structure [0-9]+: its content"):
                list(damaged.seed_structures())

    def test_reference_volumes_are_verified(self) -> None:
        from calmwalk import checksums

        columns = checksums.REFERENCE_VOLUME.columns
        right = checksums.checksum((kind, {"walk": 1, "volume": 540.25}[name]) for name, kind in columns)
        self.change(f"INSERT INTO reference_volume VALUES (1, 540.25, {right})")
        with calmwalk.open(self.copy) as campaign:
            self.assertEqual([walk.reference_volume for walk in campaign.walks()][:3], [None, 540.25, None])
        self.change("UPDATE reference_volume SET volume = 541")
        with (
            calmwalk.open(self.copy) as damaged,
            self.assertRaisesRegex(DamagedError, "reference volume 1: its content"),
        ):
            list(damaged.walks())

    def test_nothing_is_written(self) -> None:
        before = self.file.read_bytes()
        with calmwalk.open(self.copy) as campaign:
            list(campaign.dataset(control=True, imported=True))
            with self.assertRaisesRegex(StoreError, "readonly database"):
                campaign.rows("DELETE FROM walk")
        self.assertEqual(self.file.read_bytes(), before)

    def test_labels_of_several_protocols_must_be_chosen(self) -> None:
        small_campaign.run(
            "import", str(self.copy), str(self.directory / "imported.extxyz"), "--protocol", "other"
        )
        with calmwalk.open(self.copy) as campaign:
            with self.assertRaisesRegex(StoreError, "labels of several protocols: choose one of .*'other'"):
                list(campaign.dataset(imported=True))
            frames = list(campaign.dataset(protocol="other", imported=True))
            self.assertEqual([frame.info["protocol"] for frame in frames], ["other"])
            self.assertEqual(len(list(campaign.labels(protocol="other"))), 1)


def _flipped(data: bytes, at: int) -> bytes:
    return data[:at] + bytes([data[at] ^ 4]) + data[at + 1 :]


class SourceTests(unittest.TestCase):
    """What the Rust sources say, in a checkout that has them."""

    def test_the_newest_schema_is_that_of_the_program(self) -> None:
        for file in ("sqlite/open.rs", "postgres/open.rs"):
            text = (small_campaign.ROOT / "store" / "src" / file).read_text()
            found = re.search(r"const SCHEMA: i64 = (\d+);", text)
            self.assertIsNotNone(found)
            self.assertEqual(int(found[1]), NEWEST_SCHEMA, "let calmwalk.store read the new tables")

    def test_the_checked_columns_are_those_of_the_program(self) -> None:
        from calmwalk import checksums

        text = (small_campaign.ROOT / "store" / "src" / "checksum.rs").read_text()
        found = re.findall(r'checked!\("(\w+)" by (\w+) \w+ \{([^}]*)\}\)', text)
        tables = {
            table.name: table
            for table in vars(checksums).values()
            if isinstance(table, checksums.CheckedTable)
        }
        self.assertGreater(len(tables), 10)
        for name, key, columns in found:
            if name in tables:
                listed = [tuple(column.lower().split(": ")) for column in re.findall(r"\w+: \w+", columns)]
                self.assertEqual(tables.pop(name), checksums.CheckedTable(name, key, tuple(listed)))
        self.assertEqual(tables, {})


class EncodingTests(unittest.TestCase):
    def test_compressed_numbers_of_early_versions(self) -> None:
        """The row of store/src/numbers.rs."""
        from calmwalk.blocks import decode_numbers
        from calmwalk.store_errors import MissingPackage

        row = bytes(
            [3, 0, 0, 0, 0, 0, 0, 0, 0x28, 0xB5, 0x2F, 0xFD, 0, 0x48, 0x75, 0, 0, 0x40, 0, 0, 0xF8, 0xD0, 8]
        )
        row += bytes([0x3F, 0xBF, 0x40, 1, 0, 8, 0xC0, 2])
        try:
            self.assertEqual(list(decode_numbers(row)), [1.5, -0.25, 3.0])
        except MissingPackage as error:
            self.assertIn("pip install zstandard", str(error))


if __name__ == "__main__":
    unittest.main()
