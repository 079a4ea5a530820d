"""A recording in pandas: how well the offset fits the measured deformation.  python recording_pandas.py FILE.mcap."""

from __future__ import annotations

import json
import sys

import pandas as pd
from mcap.reader import make_reader

TOPICS = ["/sample", "/estimate", "/offset"]


def tables(path: str) -> dict[str, pd.DataFrame]:
    """Read the messages of each topic into a table with the sample's number `seq` as index.

    Parameters
    ----------
    path : str
        A finished recording.

    Returns
    -------
    dict of str to pandas.DataFrame
        By topic; nested values have names such as `channels.t_q_degc.mean`. A missing value is NaN.
    """
    rows: dict[str, list[dict[str, object]]] = {topic: [] for topic in TOPICS}
    with open(path, "rb") as file:  # noqa: PTH123  as a user would
        for _, channel, message in make_reader(file).iter_messages(topics=TOPICS):
            rows[channel.topic].append(json.loads(message.data))
    return {topic: pd.json_normalize(found).set_index("seq") for topic, found in rows.items()}


def main(path: str) -> None:
    """Print states and the deformation before and after compensation."""
    found = tables(path)
    data = found["/estimate"].merge(found["/offset"], on="seq", suffixes=("", "_offset"))
    data.index = pd.to_datetime(data["time_utc_ns"], utc=True)
    print(f"{len(data)} samples, {data.index[0]:%Y-%m-%d %H:%M} to {data.index[-1]:%H:%M} UTC")
    print(data["state"].value_counts().to_string())
    # The offset is added to the commanded Y: the remaining error is the sum of both.
    data["left_um"] = data["y_um"] + data["y_offset_um"]
    print(data[["y_um", "y_offset_um", "left_um"]].astype(float).describe().loc[["mean", "std", "min", "max"]].round(2))


if __name__ == "__main__":
    main(sys.argv[1])
