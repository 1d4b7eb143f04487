"""Derivatives, batches, padding, permutation and repeats of every adapter."""

from __future__ import annotations

import unittest

from calmwalk.adapter import Adapter
from calmwalk.adapters.radial import Radial
from calmwalk.check import Check

from .client import DATA


class Checks(unittest.TestCase):
    def check(self, adapter: Adapter, distance: float = 2.6) -> None:
        check = Check(adapter, distance=distance)
        for name, error in check.all().items():
            with self.subTest(name):
                self.assertLessEqual(error, check.limit(name))

    def test_radial(self) -> None:
        for model in ("radial-al.json", "radial-alcu.json"):
            for precision in ("double", "single"):
                with self.subTest(model=model, precision=precision):
                    self.check(Radial(DATA / model, {}, precision=precision))


if __name__ == "__main__":
    unittest.main()
