"""The file of an alarm's certificate."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from obsynth.files.outputs import FileKind
from obsynth.results.gain_sets import digest_of

SCHEMA_VERSION = 1
KIND = "obsynth alarm certificate"
CERTIFICATE = FileKind("an alarm certificate", b'"kind": "obsynth alarm certificate"')


def document(certificate: Mapping[str, Any]) -> str:
    """Return the text of the file."""
    body = {"kind": KIND, "schema_version": SCHEMA_VERSION, "sha256": digest_of(certificate),
            "certificate": certificate}  # fmt: skip
    return json.dumps(body, indent=1, allow_nan=False) + "\n"
