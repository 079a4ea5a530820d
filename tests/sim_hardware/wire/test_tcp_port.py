"""A TCP port that closes leaves no connection open, whenever it closes."""

import asyncio
import socket

import pytest

from sim_hardware.wire.tcp_port import Connection, TcpPort


@pytest.mark.parametrize("turns", range(6))
@pytest.mark.parametrize("ending", [TcpPort.close, TcpPort.refuse])
def test_who_connects_while_the_port_closes_is_dropped(ending, turns):
    """On its way from the kernel to its protocol, a connection takes a few turns of the loop."""

    async def run():
        port = TcpPort(0, Connection)
        await port.listen()
        with socket.create_connection((port.host, port.port)) as client:
            for _ in range(turns):
                await asyncio.sleep(0)
            await ending(port)
            # What the loop has closed is closed in this turn or in the next one; a peer left behind is heard of never.
            await asyncio.sleep(0)
            client.setblocking(False)
            try:
                heard = client.recv(1)
            except ConnectionResetError:
                heard = b""
            assert heard == b""
        await port.close()

    asyncio.run(run())
