"""Tests: `python -m unittest discover -s python/tests -t python`. The radial model and the protocol need nothing but
numpy."""
