"""Settings for every test: compiled kernels are cached by the content of all sources together.

The compiler's own cache notices an edit in the file of a kernel, not one in a file that it calls.
"""

import hashlib
import os
from pathlib import Path

_ROOT = Path(__file__).parent
_sources = sorted((_ROOT / "src").rglob("*.py"))
_digest = hashlib.sha256(b"".join(path.read_bytes() for path in _sources)).hexdigest()[:16]
os.environ.setdefault("NUMBA_CACHE_DIR", str(_ROOT / ".numba_cache" / _digest))
