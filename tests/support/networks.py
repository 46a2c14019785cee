"""The benchmarks' generator of random networks, for tests."""

from __future__ import annotations

import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

_FILE = Path(__file__).parents[2] / "benchmarks" / "networks.py"
_SPEC = spec_from_file_location("networks_benchmark", _FILE)
assert _SPEC is not None
assert _SPEC.loader is not None
_MODULE = module_from_spec(_SPEC)
sys.modules[_SPEC.name] = _MODULE
_SPEC.loader.exec_module(_MODULE)

random_network = _MODULE.random_network
write = _MODULE.write
