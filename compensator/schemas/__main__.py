"""Write the JSON Schemas of all messages beside this file."""

from __future__ import annotations

from pathlib import Path

import msgspec

from compensator.messages import schemas
from compensator.messages_axes import ALL_MESSAGES

for _name, _schema in schemas(ALL_MESSAGES).items():
    _text = msgspec.json.format(msgspec.json.encode(_schema), indent=1)
    Path(__file__).with_name(f"{_name}.schema.json").write_bytes(_text + b"\n")
