"""Simulated measuring devices with the real protocols over TCP ports and pseudo-terminals."""

from sim_hardware.wire.adam import Adam
from sim_hardware.wire.capancdt import CapaNcdt
from sim_hardware.wire.dcon import DconLine
from sim_hardware.wire.dcon_slave import DconSettings
from sim_hardware.wire.faults import DEVICE_FAULTS, INPUT_FAULTS, Faults
from sim_hardware.wire.icpdas import IcpDas
from sim_hardware.wire.modbus_servers import ModbusRtuLine, ModbusRtuTcpServer, ModbusTcpServer
from sim_hardware.wire.module import Module, Source
from sim_hardware.wire.moxa import MoxaE1262
from sim_hardware.wire.printing import PrintingControl
from sim_hardware.wire.rack import Rack, Server
from sim_hardware.wire.register_map import Register, RegisterMap

__all__ = [
    "DEVICE_FAULTS",
    "INPUT_FAULTS",
    "Adam",
    "CapaNcdt",
    "DconLine",
    "DconSettings",
    "Faults",
    "IcpDas",
    "ModbusRtuLine",
    "ModbusRtuTcpServer",
    "ModbusTcpServer",
    "Module",
    "MoxaE1262",
    "PrintingControl",
    "Rack",
    "Register",
    "RegisterMap",
    "Server",
    "Source",
]
