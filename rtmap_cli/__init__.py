"""rtmap keeps HD maps true: infer, localize, detect changes, crowdsource, evaluate."""

__version__ = "0.1.0"
