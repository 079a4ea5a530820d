"""A certificate that publishes the length of the tool, and nothing else; and receivers that read every axis."""

from __future__ import annotations

from typing import Any

import zenoh

from tests.security.shop import EVIL, OFFSET, PREFIX, Plant, Shop, wait

LENGTH = f"{PREFIX}/thermal/tool_length"


def test_it_publishes_the_length_and_nothing_else(plant: Plant, shop: Shop) -> None:
    plant.forget()
    seen: list[tuple[str, bytes]] = []
    others: list[Any] = []
    with zenoh.open(shop.config("receiver-cnc-07")) as control, zenoh.open(shop.config("tool-tool-07")) as session:
        control.declare_subscriber(
            f"{PREFIX}/**", lambda sample: seen.append((str(sample.key_expr), sample.payload.to_bytes()))
        )
        publisher = session.declare_publisher(LENGTH)
        wait(lambda: publisher.matching_status.matching, "the subscription of the control")
        # Not before: it would match, too.
        session.declare_subscriber("**", others.append)
        for key in (
            OFFSET,
            f"{PREFIX}/thermal/status",
            "shop/vmc-08/thermal/tool_length",
            f"{PREFIX}/thermal/z/offset",
        ):
            session.put(key, EVIL)
        publisher.put(b"length")
        wait(lambda: (LENGTH, b"length") in seen, "the length at the control")
        marker = plant.publish()
        wait(lambda: (OFFSET, marker) in seen, "the genuine offset at the control")
        assert {key for key, _ in seen} == {LENGTH, OFFSET} and EVIL not in [payload for _, payload in seen]
        assert list(session.get(OFFSET, timeout=5.0)) == []
        # What it has published itself never left its own session, except the length.
        assert {sample.payload.to_bytes() for sample in others} == {EVIL, b"length"}


def test_a_receiver_publishes_none_and_may_ask_for_every_axis(plant: Plant, shop: Shop) -> None:
    plant.forget()
    marker = plant.publish()
    with zenoh.open(shop.config("receiver-cnc-07")) as control, zenoh.open(shop.config("receiver-watch")) as screen:
        seen: list[Any] = []
        screen.declare_subscriber(LENGTH, seen.append)

        def answers() -> list[bytes]:
            replies = control.get(f"{PREFIX}/thermal/*/offset", timeout=5.0)
            return [reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None]

        wait(lambda: answers() == [marker], "the answer to a query of all axes")
        control.put(LENGTH, b"length")
        assert answers() == [marker] and seen == []  # what is sent over one link is handled in its order
