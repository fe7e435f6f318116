"""Commands and the one place where errors become messages."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence

from cyclopts import App
from rich.console import Console
from rich.markup import escape

from overtone._version import __version__
from overtone.cli.calibrate import calibrate_curve
from overtone.cli.demo import demo
from overtone.cli.demodulate import demodulate
from overtone.cli.export import export
from overtone.cli.inspect import inspect
from overtone.cli.map import map_scan
from overtone.cli.models import models
from overtone.cli.plan import plan
from overtone.cli.protocol import protocol
from overtone.cli.simulate import simulate
from overtone.cli.simulate_scan import scan as simulate_scan
from overtone.cli.thermal import thermal
from overtone.errors import OvertoneError, OvertoneWarning

app = App(
    name="overtone",
    help="Nanomechanics from an ordinary tapping-mode AFM scan, with an answer to how sure it is.",
    version=__version__,
)
app.command(demo)
app.command(inspect)
app.command(map_scan, name="map")
app.command(calibrate_curve, name="calibrate")
app.command(export)
app.command(plan)
app.command(models)
simulate.command(simulate_scan, name="scan")
app.command(simulate)
app.command(demodulate)
app.command(protocol)
app.command(thermal)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line; errors of overtone end it with their message and exit code 1."""
    try:
        with warnings.catch_warnings():
            # What these warnings say is kept as findings, and printed with the result.
            warnings.simplefilter("ignore", OvertoneWarning)
            app(arguments)
    except OvertoneError as error:
        console = Console(stderr=True)
        console.print(f"[bold red]{type(error).__name__}[/]: {escape(str(error))}", soft_wrap=True)
        sys.exit(1)
    except OSError as error:
        Console(stderr=True).print(
            f"[bold red]{type(error).__name__}[/]: {escape(str(error))}", soft_wrap=True
        )
        sys.exit(1)
    except KeyboardInterrupt:
        Console(stderr=True).print("stopped; no file was left half written")
        sys.exit(130)
