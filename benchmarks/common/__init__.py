"""What several rooms share: places, worlds, verdicts, tables in Markdown."""
