"""rtmap map review: decide on the changes of a file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rtmap_cli import options

if TYPE_CHECKING:
    from rtmap_cli.formats.change_file import ReviewFile

MANY = ("--accept", "--reject", "--reopen")


class _ManyIds(click.Command):
    """A command whose options of ids take all words up to the next option, once FILE is there."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """``FILE --accept a b c`` becomes ``FILE --accept a --accept b --accept c``."""
        out: list[str] = []
        many, first = "", True
        file = bool(args) and not args[0].startswith("-")
        for word in args:
            if word.startswith("-") and word != "-":
                many, first = (word if word in MANY and file else ""), True
            elif many and not first:
                out.append(many)
            else:
                first = False
            out.append(word)
        return super().parse_args(ctx, out)


@click.command("review", cls=_ManyIds)
@click.argument("changes", metavar="FILE", type=options.PATH)
@click.option("--accept", multiple=True, metavar="ID...", help="Accept these changes.")
@click.option("--reject", multiple=True, metavar="ID...", help="Reject these changes.")
@click.option("--reopen", multiple=True, metavar="ID...", help="Forget the decision on these.")
@click.option(
    "--accept-if", multiple=True, metavar="CONDITION", help="Accept open changes that fulfil this."
)
@click.option(
    "--reject-if", multiple=True, metavar="CONDITION", help="Reject open changes that fulfil this."
)
@options.output("Write the decisions to another file, and leave FILE as it is.", required=False)
@options.overwrite
@options.as_json
def command(
    changes: Path,
    accept: tuple[str, ...],
    reject: tuple[str, ...],
    reopen: tuple[str, ...],
    accept_if: tuple[str, ...],
    reject_if: tuple[str, ...],
    output: Path | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """List the changes of FILE and what was decided on them, or decide.

    FILE is what detect-changes or update wrote. Decisions stand in the property `review` of each
    change (accepted, rejected; none: open) and nothing else of FILE is touched; `rtmap map apply`
    makes the accepted changes. Ids are decided first; conditions decide what is still open then,
    rejecting ones before accepting ones. A condition compares properties:
    'probability>0.95 and class in (divider, boundary)'.

    \b
    Example:
      rtmap map review changes.geojson --accept-if 'probability>0.95'
    """
    from rtmap_cli.errors import UsageError
    from rtmap_cli.formats.change_file import ACCEPTED, REJECTED, read_review_file
    from rtmap_cli.formats.change_file import write_review_file as write
    from rtmap_cli.maps.condition import parse_condition
    from rtmap_cli.output import emit, log
    from rtmap_cli.tables import refuse_existing

    conditions = [
        (state, parse_condition(text))
        for state, texts in ((REJECTED, reject_if), (ACCEPTED, accept_if))
        for text in texts
    ]
    if output is not None:
        refuse_existing(output, overwrite)
    file = read_review_file(changes)
    decisions: dict[str, str | None] = {}
    named = ((accept, ACCEPTED), (reject, REJECTED), (reopen, None))
    for ids, state in named:
        for change_id in ids:
            known = file.by_id(change_id).change_id
            if decisions.get(known, state) != state:
                raise UsageError(f"{change_id} is both accepted and rejected")
            decisions[known] = state
    known_names = {name for c in file.changes for name in c.properties}
    for state, condition in conditions:
        if file.changes:
            condition.check_names(known_names)
        for c in file.changes:
            is_open = c.review is None and c.change_id not in decisions
            if is_open and condition(c.properties):
                decisions[c.change_id] = state
    decided = {c.change_id: decisions.get(c.change_id, c.review) for c in file.changes}
    if decisions or output is not None:
        write(file, decisions, output or changes)
    counts = {
        s or "open": sum(v == s for v in decided.values()) for s in (ACCEPTED, REJECTED, None)
    }
    told = ", ".join(f"{n} {state}" for state, n in counts.items())
    result = {
        "file": str(output or changes),
        "map_version": file.map_version,
        "counts": counts,
        "changes": [
            c.properties | {"change_id": c.change_id, "review": decided[c.change_id]}
            for c in file.changes
        ],
    }
    if not as_json:
        log(f"{output or changes}: {told}")
    emit(result, as_json, _lines(file, decided))


def _lines(file: ReviewFile, decided: dict[str, str | None]) -> list[str]:
    from rtmap_cli.output import table

    if not file.changes:
        return ["no changes"]
    rows: list[list[Any]] = []
    for c in file.changes:
        p = c.properties.get("probability")
        shown = f"{p:.3f}" if isinstance(p, int | float) else "-"
        reason = c.properties.get("reason") or "-"
        rows.append(
            [c.change_id, c.kind, c.class_name, c.element_id or "-", shown, reason,
             decided[c.change_id] or "open"]
        )  # fmt: skip
    header = ["id", "change", "class", "element", "probability", "reason", "review"]
    return table(header, rows)
