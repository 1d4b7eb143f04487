"""The code of docs/campaign.ipynb runs on a small campaign, and the notebook was executed."""

from __future__ import annotations

import importlib.util
import io
import json
import os
import tempfile
import unittest
from contextlib import redirect_stdout
from pathlib import Path
from unittest import mock

import small_campaign

_NOTEBOOK = small_campaign.ROOT / "docs" / "campaign.ipynb"
_NEEDS = ("numpy", "pandas", "ase")


class NotebookTests(unittest.TestCase):
    def setUp(self) -> None:
        self.cells = json.loads(_NOTEBOOK.read_text())["cells"]
        self.code = [cell for cell in self.cells if cell["cell_type"] == "code"]

    def test_it_has_ten_executed_cells_with_small_outputs(self) -> None:
        self.assertEqual(len(self.cells), 10)
        self.assertEqual([cell["execution_count"] for cell in self.code], list(range(1, len(self.code) + 1)))
        for cell in self.code:
            kinds = {output["output_type"] for output in cell["outputs"]}
            self.assertTrue(kinds and kinds <= {"stream", "execute_result"}, kinds)
            self.assertNotIn("stderr", {output.get("name") for output in cell["outputs"]})
        self.assertLess(_NOTEBOOK.stat().st_size, 40_000)

    @unittest.skipUnless(small_campaign.program(), "there is no calmwalk binary")
    @unittest.skipUnless(all(map(importlib.util.find_spec, _NEEDS)), f"needs {', '.join(_NEEDS)}")
    def test_its_code_runs(self) -> None:
        directory = Path(self.enterContext(tempfile.TemporaryDirectory()))
        location = small_campaign.make(directory)
        self.enterContext(mock.patch.dict(os.environ, CALMWALK_CAMPAIGN=location))
        names: dict[str, object] = {}
        printed = io.StringIO()
        for number, cell in enumerate(self.code, 1):
            with self.subTest(cell=number), redirect_stdout(printed):
                exec(compile("".join(cell["source"]), f"cell {number}", "exec"), names)
        self.assertIn("structures,", printed.getvalue())


if __name__ == "__main__":
    unittest.main()
