"""Run CoACD on one mesh: ``python -P coacd_process.py MESH.npz PIECES.npz SETTINGS``.

CoACD is C++ that can crash on a broken mesh and cannot be interrupted, so ``replace_collision``
runs it in a process of its own. This module imports nothing of morphgen, and so starts at once.
"""

from __future__ import annotations

import json
import sys

import coacd
import numpy as np


def main(mesh_file: str, pieces_file: str, settings: str) -> None:
    """Decompose a mesh from an npz file (``vertices``, ``faces``) to one with numbered pieces."""
    coacd.set_log_level("error")
    with np.load(mesh_file, allow_pickle=False) as arrays:
        mesh = coacd.Mesh(arrays["vertices"], arrays["faces"])
    pieces = coacd.run_coacd(mesh, **json.loads(settings))
    np.savez(pieces_file, **{f"{i:03d}": vertices for i, (vertices, _) in enumerate(pieces)})


if __name__ == "__main__":
    main(*sys.argv[1:])
