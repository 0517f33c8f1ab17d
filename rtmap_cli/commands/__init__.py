"""One thin file per verb: options in, one call into steps, report out."""
