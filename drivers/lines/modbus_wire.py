"""One Modbus connection: a pymodbus client whose input is checked before pymodbus decodes it."""

from __future__ import annotations

import asyncio
import logging
import termios

from pymodbus import FramerType, ModbusException
from pymodbus.client import AsyncModbusSerialClient, AsyncModbusTcpClient
from pymodbus.client.base import ModbusBaseClient
from pymodbus.exceptions import ConnectionException
from pymodbus.pdu import ModbusPDU

from drivers.errors import failure_text
from drivers.lines.settings import SerialLine, TcpLine
from drivers.protocols.modbus import (
    READ_COILS,
    READ_DISCRETE,
    READ_HOLDING,
    READ_INPUT,
    Request,
    WrongAnswerError,
    describe_rtu,
    find_rtu,
    find_tcp,
)

# pymodbus logs every missed answer as an error with a dump of frames; here each becomes one DriverError. A level set
# on purpose stays.
if logging.getLogger("pymodbus").level == logging.NOTSET:
    logging.getLogger("pymodbus").setLevel(logging.CRITICAL)

# Far more than any frame with late ones before it, and small enough to search at every arrival.
_MOST_BUFFERED = 8192
_MOST_RECEIVED = 1024


class RefusalError(Exception):
    """An exception reply; `code` is the device's."""

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


class LostError(Exception):
    """The connection cannot be made or is gone; the text says why."""


class ModbusWire:
    """One connection, used by one request at a time.

    Parameters
    ----------
    config : SerialLine or TcpLine
        Settings of the line.
    """

    def __init__(self, config: SerialLine | TcpLine) -> None:
        self._numbered = config.protocol == "modbus-tcp"
        self._request: Request | None = None
        self._unit = 0
        self._transaction = 0
        self._wrong: WrongAnswerError | None = None
        self._received = bytearray()
        self.received_at_s = 0.0
        self._why = ""
        self._client = self._make(config)
        create = self._client.ctx.call_create

        # pymodbus hides why a connection failed, and lets some of pyserial's errors through.
        async def explained() -> object:
            try:
                return await create()
            except (OSError, ValueError, termios.error) as error:
                self._why = failure_text(error)
                raise OSError(self._why) from error

        self._client.ctx.call_create = explained
        # Beyond its own limit pymodbus drops its buffer unseen, and garbage looks like a timeout.
        self._client.ctx.max_buffer_size = _MOST_BUFFERED
        # The line decides whether a timeout ends the connection.
        self._client.set_max_no_responses(1 << 30)

    def _make(self, config: SerialLine | TcpLine) -> ModbusBaseClient:
        """Make the client that fits the line; it never retries or reconnects by itself."""
        if isinstance(config, SerialLine):
            return AsyncModbusSerialClient(
                config.port,
                framer=FramerType.RTU,
                baudrate=config.baudrate,
                parity=config.parity,
                stopbits=config.stopbits,
                timeout=config.timeout_s,
                retries=0,
                reconnect_delay=0,
                trace_packet=self._trace_packet,
                trace_connect=self._trace_connect,
            )
        return AsyncModbusTcpClient(
            config.host,
            port=config.tcp_port,
            framer=FramerType.SOCKET if self._numbered else FramerType.RTU,
            timeout=config.timeout_s,
            retries=0,
            reconnect_delay=0,
            trace_packet=self._trace_packet,
            trace_connect=self._trace_connect,
        )

    @property
    def connected(self) -> bool:
        """Whether the connection is open, as far as is known."""
        return self._client.connected

    async def connect(self) -> None:
        """Connect once, within the line's time limit.

        Raises
        ------
        LostError
            The port or host is not there, or refuses.
        TimeoutError
            Nothing answered.
        """
        self._why = ""
        if not await self._client.connect():
            if self._why:
                raise LostError(self._why)
            raise TimeoutError
        # A serial transport reports itself one turn of the loop later.
        await asyncio.sleep(0)

    def close(self) -> None:
        """Close the connection. A request that waits on it fails at once."""
        self._client.close()
        self._fail(ConnectionException("closed"))

    async def ask(self, unit: int, request: Request) -> ModbusPDU:
        """Send one request and wait for its answer.

        Raises
        ------
        RefusalError
            The device sent an exception reply.
        WrongAnswerError
            What came is not the answer.
        TimeoutError
            Nothing came.
        LostError
            The connection broke.
        """
        self._request, self._unit, self._wrong = request, unit, None
        self._received.clear()
        try:
            answer = await self._send(unit, request)
        except ConnectionException as error:
            raise LostError(self._why or "connection lost") from error
        except ModbusException as error:
            raise self._why_no_answer(unit, request) from error
        finally:
            self._request = None
        if answer.isError():
            raise RefusalError(answer.exception_code)
        return answer

    async def _send(self, unit: int, request: Request) -> ModbusPDU:
        """Call the client's method for the function."""
        client, address, count = self._client, request.address, request.count
        if request.function == READ_HOLDING:
            return await client.read_holding_registers(address, count=count, device_id=unit)
        if request.function == READ_INPUT:
            return await client.read_input_registers(address, count=count, device_id=unit)
        if request.function == READ_COILS:
            return await client.read_coils(address, count=count, device_id=unit)
        if request.function == READ_DISCRETE:
            return await client.read_discrete_inputs(address, count=count, device_id=unit)
        raise ValueError(f"function {request.function} is no read function")

    def _why_no_answer(self, unit: int, request: Request) -> WrongAnswerError | TimeoutError:
        """Distinguish a silent device from one with a wrong answer."""
        if self._wrong is not None:
            return self._wrong
        if not self._numbered and (why := describe_rtu(bytes(self._received), unit, request)):
            return WrongAnswerError(why)
        return TimeoutError()

    def _trace_packet(self, sending: bool, data: bytes) -> bytes:
        """Select what pymodbus decodes: the one frame that answers the request, or nothing yet."""
        if sending:
            self._transaction = int.from_bytes(data[:2], "big")
            return data
        self.received_at_s = asyncio.get_running_loop().time()
        if self._request is None or self._wrong is not None:
            return b""
        if self._numbered:
            try:
                return find_tcp(data, self._transaction, self._unit, self._request) or b""
            except WrongAnswerError as error:
                self._wrong = error
                self._fail(ModbusException(str(error)))
                return b""
        # pymodbus passes everything since the request, unless it has given up on it.
        self._received[:] = data[-_MOST_RECEIVED:]
        return find_rtu(data, self._unit, self._request) or b""

    def _trace_connect(self, connected: bool) -> None:
        """Fail the waiting request when the connection breaks; pymodbus alone would wait for the timeout."""
        if not connected:
            self._fail(ConnectionException("connection lost"))

    def _fail(self, error: ModbusException) -> None:
        """Fail the pending request, if there is one."""
        waiting = self._client.ctx.response_future
        if self._request is not None and not waiting.done():
            waiting.set_exception(error)
