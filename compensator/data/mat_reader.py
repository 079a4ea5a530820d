"""What scipy reads of a MAT file, by a process of its own that `files.py` starts: `python mat_reader.py FILE`.

scipy's reader is compiled code that believes what a file says of its parts, so one wrong byte can end the process that
reads it. This one imports nothing of the project and writes what was read, or the error, to its output.
"""

from __future__ import annotations

import pickle
import resource
import sys
import warnings
import zlib

#: What scipy raises for a damaged file besides its own error, and pandas for a damaged workbook.
DAMAGED = (zlib.error, ValueError, TypeError, LookupError, EOFError, ArithmeticError, MemoryError, OSError)

#: Memory that reading a file takes at most, and what is read of it, bytes: a packed file of a few megabytes can ask for
#: a thousand times as much.
MEMORY_BYTES, READ_BYTES = 4_000_000_000, 1_000_000_000


def main() -> None:
    """Read the file that the argument names."""
    limits = resource.getrlimit(resource.RLIMIT_AS)
    least = min([MEMORY_BYTES, *(limit for limit in limits if limit != resource.RLIM_INFINITY)])
    resource.setrlimit(resource.RLIMIT_AS, (least, limits[1]))
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    warnings.simplefilter("ignore")  # about objects that it cannot read
    found: object
    try:
        found = loadmat(sys.argv[1], squeeze_me=True, mat_dtype=False)
    except (NotImplementedError, MatReadError, *DAMAGED) as error:
        # What zlib calls error −4 is that there is no more memory.
        found = MemoryError("no memory to unpack it") if str(error).startswith("Error -4 ") else error
    data = pickle.dumps(found)
    if len(data) > READ_BYTES:
        data = pickle.dumps(ValueError(f"more than {READ_BYTES} bytes of values"))
    sys.stdout.buffer.write(data)


if __name__ == "__main__":
    main()
