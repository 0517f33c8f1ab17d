"""rtmap check-log: name what is wrong with a log."""

from __future__ import annotations

import click

from rtmap_cli import options


@click.command("check-log")
@click.argument("log")
@click.option("--fast", is_flag=True, help="Do not decode images: header and end marker only.")
@options.as_json
@click.pass_context
def command(context: click.Context, log: str, fast: bool, as_json: bool) -> None:
    """Name everything that is wrong with a log, one line each: file, what, what to do.

    LOG is a native log folder (docs/log-format.md), an Argoverse 2 sensor log, a scene of nuScenes
    or DGP (DIR#SCENE), or a nuScenes info file (.pkl); av2:, nuscenes: or dgp: before it force the
    format. Exit code 0: clean or warnings only; 3: errors, the log cannot be used as it is.

    \b
    Example:
      rtmap check-log logs/monday
    """
    from rtmap_cli.formats.av2.check import check_av2
    from rtmap_cli.logs.check import check_native
    from rtmap_cli.logs.check_frames import check_opened
    from rtmap_cli.logs.open import log_format
    from rtmap_cli.output import emit

    kind, folder = log_format(log)
    if kind in ("native", "av2"):
        report = (check_av2 if kind == "av2" else check_native)(folder, fast)
    else:
        report = check_opened(log, folder, fast)
    findings = sorted(report.findings, key=lambda f: (f.level, f.file))
    told = f"{report.errors} errors, {report.warnings} warnings"
    emit(
        {
            "log": str(folder),
            "format": kind,
            "errors": report.errors,
            "warnings": report.warnings,
            "findings": [finding.as_dict() for finding in findings],
        },
        as_json,
        [*(finding.line() for finding in findings), f"{folder}: {told}"],
    )
    if report.errors:
        context.exit(3)
