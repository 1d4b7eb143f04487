"""The adapters of docs/python-adapters.md, run from the page."""

from __future__ import annotations

import re
import tempfile
import unittest
from pathlib import Path

from calmwalk.check import Check
from calmwalk.loading import find_adapter

from .test_adapters import need

PAGE = Path(__file__).resolve().parent.parent.parent / "docs" / "python-adapters.md"


class AdaptersOfThePage(unittest.TestCase):
    @classmethod
    def setUpClass(cls) -> None:
        need("mace", "torch", "mace")
        folder = tempfile.TemporaryDirectory()
        cls.addClassCleanup(folder.cleanup)
        cls.folder = Path(folder.name)
        for name, code in zip(("short.py", "plain.py"), re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.S)):
            (cls.folder / name).write_text(code)
        find_adapter("mace")  # makes mace-torch run with a torch before 2.1

    def check(self, adapter: str, model: Path) -> None:
        for precision in ("double", "single"):
            check = Check(find_adapter(f"{self.folder}/{adapter}")(model, {}, precision=precision))
            for name, error in check.all().items():
                with self.subTest(name, precision=precision):
                    self.assertLessEqual(error, check.limit(name))

    def test_mace(self) -> None:
        from .make_mace import make

        model = self.folder / "mace.model"
        make(str(model))
        self.check("short.py:Mace", model)

    def test_plain(self) -> None:
        import torch

        from calmwalk.loading import load_module

        torch.manual_seed(1)
        model = self.folder / "plain.pt"
        torch.save(load_module(f"{self.folder}/plain.py").Net().state_dict(), model)
        self.check("plain.py:Plain", model)


if __name__ == "__main__":
    unittest.main()
