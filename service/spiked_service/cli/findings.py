"""How the findings of a doctor are printed."""

import json
from collections.abc import Sequence
from dataclasses import asdict

import typer

from spiked_service.cli.console import output
from spiked_service.operations.doctor import Diagnosis, DiagnosisStatus

_COLOURS = {DiagnosisStatus.OK: "green", DiagnosisStatus.WARNING: "yellow", DiagnosisStatus.PROBLEM: "red"}


def show_findings(findings: Sequence[Diagnosis], as_json: bool) -> None:
    """Print findings, as text or JSON. Raises typer.Exit with 1 if one is a problem."""
    if as_json:
        print(json.dumps([asdict(finding) for finding in findings], indent=2))
    else:
        for finding in findings:
            output.print(f"[{_COLOURS[finding.status]}]{finding.status:8s}[/] {finding.name}: ", end="")
            output.print(finding.finding, markup=False)
            if finding.what_to_do:
                output.print(f"         {finding.what_to_do}", markup=False)
    if any(finding.status is DiagnosisStatus.PROBLEM for finding in findings):
        raise typer.Exit(1)
