"""``sparserob check``: verify a finished run anew."""

from __future__ import annotations

import math
from pathlib import Path

import click

from sparserob_core.experiment.cli.shell.options import json_option, plugins_option
from sparserob_core.experiment.cli.shell.report import report
from sparserob_core.experiment.terminal.printing import EXIT


@click.command()
@click.argument("directory", metavar="RUN", type=click.Path(path_type=Path))
@json_option("the verdicts as JSON")
@plugins_option
@click.option(
    "--seconds",
    type=click.FloatRange(min=0.0, min_open=True),
    default=math.inf,
    metavar="N",
    help="Stop after N seconds: what was decided by then is shown, the rest is not checked.",
)
def check(directory: Path, as_json: bool, plugins: tuple[Path, ...], seconds: float) -> int:
    """Verify a finished run: every claim of its certificate, derived anew.

    Reads RUN/config.yaml and RUN/certificate.json, computes every bound again in ball arithmetic, and shares no code
    with what solved the problem. Prints one verdict per claim: it holds, fails, or was not checked, with the reason;
    and what the files say besides that nothing was compared with, which changes no verdict.

    Exit status: 0 when every claim holds, 4 when one fails or was not checked, 2 when the input is at fault.
    """
    from dataclasses import asdict

    from sparserob_core.experiment.check.check import check as verify

    verification = verify(directory, plugins, seconds)
    summary = {
        "title": verification.title,
        "status": verification.status,
        "seconds": verification.seconds,
        "claims": [asdict(claim) for claim in verification.claims],
        "not_compared": list(verification.not_compared),
    }
    rows = [(claim.name, claim.verdict, claim.text) for claim in verification.claims]
    all_hold = "every claim holds; " if verification.status == "verified" else ""
    remarks = (
        f"not compared: {'; '.join(verification.not_compared) or 'nothing'}",
        f"{verification.status}: {all_hold}in {verification.seconds:.2f} s",
    )
    report(as_json, summary, [(verification.title, ("claim", "verdict", "what was derived"), rows)], remarks)
    return EXIT[verification.status]
