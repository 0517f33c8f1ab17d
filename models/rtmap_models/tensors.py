"""Files of torch, read without executing anything: the only place where ``torch.load`` stands."""

from __future__ import annotations

import pickle
import struct
from pathlib import Path
from typing import Any

import torch

from rtmap_cli.errors import BadInput


def read_tensors(path: Path, what: str, missing: str, broken: str) -> Any:
    """The content of a file of tensors and plain values (``weights_only``), on the CPU.

    BadInput says that it is not ``what``; ``missing`` and ``broken`` tell what to do when there is
    no such file and when it cannot be read.
    """
    if not path.is_file():
        raise BadInput(path, "no such file", missing)
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except (pickle.PickleError, LookupError, ValueError, EOFError, struct.error) as error:
        # torch's own words are the unpickler's, or advise to unpickle whatever it is.
        raise BadInput(path, f"not {what}: no file of plain tensors", broken) from error
    except (RuntimeError, OSError) as error:
        first = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise BadInput(path, f"not {what}: {first}", broken) from error
