"""``morphgen view``: a robot in the browser."""

from __future__ import annotations

import argparse
from pathlib import Path

from morphgen.cli.options import Subparsers


def add_parser(commands: Subparsers) -> None:
    """Declare the command."""
    parser = commands.add_parser(
        "view",
        help="show a bundle in the browser, with a slider a joint",
        description="Show a bundle in the browser, with a slider a joint, until interrupted.",
    )
    parser.add_argument("bundle", type=Path, help="a bundle's folder")
    parser.add_argument(
        "--host", default="127.0.0.1", help="address to bind (default: this machine)"
    )
    parser.add_argument("--port", type=int, default=8080)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Serve until interrupted."""
    from morphgen.errors import MorphgenError
    from morphgen.viewer.page import serve

    if not 0 < args.port < 65536:
        raise MorphgenError(f"--port {args.port}: expected 1 to 65535")
    server = serve(args.bundle, args.host, args.port)
    print(f"http://{args.host}:{server.get_port()}  (stop with Ctrl-C)", flush=True)
    try:
        server.sleep_forever()
    except KeyboardInterrupt:
        server.stop()
    return 0
