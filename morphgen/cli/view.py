"""``morphgen view``: robots in the browser."""

from __future__ import annotations

import argparse
import sys

from morphgen.cli.options import Subparsers, add_library

LOCAL = ("127.0.0.1", "localhost", "::1")


def add_parser(commands: Subparsers) -> None:
    """Declare the command."""
    parser = commands.add_parser(
        "view",
        help="look at robots in the browser: browse, compose, compare, see them at work",
        description="Look at robots in the browser, until interrupted. Without a target: the "
        "library, the splits and the robots of this folder.",
        epilog="examples: morphgen view; morphgen view robots/arm3; "
        "morphgen view extrapolation/arms/reach; morphgen view arm=ur5 ee=plane; "
        "morphgen view some.urdf; morphgen view runs/reach/checkpoint.pt; "
        "morphgen view episode.npz",
    )
    parser.add_argument(
        "words",
        nargs="*",
        metavar="TARGET",
        help="a folder of robots, a bundle, a URDF or xacro, a split's name or file, a grammar, "
        "words as for morphgen compose, a checkpoint or a run's folder whose policy is to be seen "
        "at work, or an episode that the page has saved",
    )
    parser.add_argument(
        "--host", default="127.0.0.1", help="address to bind (default: this machine)"
    )
    parser.add_argument("--port", type=int, default=8080)
    add_library(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Serve until interrupted."""
    from morphgen.errors import MorphgenError
    from morphgen.viewer.app import serve

    if not 0 < args.port < 65536:
        raise MorphgenError(f"--port {args.port}: expected 1 to 65535")
    viewer = serve(args.words, args.host, args.port, args.library)
    if args.host not in LOCAL:
        print(
            f"morphgen: warning: --host {args.host}: whoever can reach this machine can use this "
            "page, see the robots of this folder and write into it; there is no password",
            file=sys.stderr,
        )
    print(f"http://{args.host}:{viewer.port}  (stop with Ctrl-C)", flush=True)
    try:
        viewer.server.sleep_forever()
    except KeyboardInterrupt:
        viewer.stop()
    return 0
