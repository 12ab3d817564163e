"""Prints sum of values, number of pixels, and the sum of the residual times its pixels, of batches of `dots.zarr`.

Run as `python read_dots.py SESSION BATCH...`; the columns are read as docs/how-to/read-dots.md shows.
"""

import json
import re
import sys
from pathlib import Path

session, *batches = sys.argv[1:]
page = (Path(__file__).resolve().parents[2] / "docs" / "how-to" / "read-dots.md").read_text()
example = re.search(r"```python\n(.*?)```", page, re.S).group(1)
for batch in batches:
    names = {"session": session}
    exec(example.replace("b0002", f"b{int(batch):04}"), names)
    columns, a = names["columns"], names["a"]
    light = columns.sum(axis=1)
    print(json.dumps({"shape": columns.shape, "pixels": int(columns.nnz), "dots": [float(x) for x in light.flat]}))
