#!/usr/bin/python3
"""What LinuxCNC starts as its display: does what a test says, one JSON line each over a socket of the file system.

Runs under the system's Python, which has LinuxCNC's modules. Ends, and LinuxCNC with it, on `quit`.
"""

import json
import os
import socket
import subprocess
import time
from pathlib import Path

if __name__ == "__main__":
    import hal
    import linuxcnc

    state = linuxcnc.stat()
    command = linuxcnc.command()
    errors = linuxcnc.error_channel()
    panel = hal.component("panel")
    panel.ready()

    def until(condition, what, timeout_s=120.0):
        end = time.monotonic() + timeout_s
        while not condition():
            if time.monotonic() > end:
                raise TimeoutError(f"{what}: not within {timeout_s} s")
            time.sleep(0.005)
            state.poll()

    def states(name):
        done = {
            "ESTOP": lambda: state.task_state == linuxcnc.STATE_ESTOP,
            "ESTOP_RESET": lambda: state.task_state != linuxcnc.STATE_ESTOP,
            "ON": lambda: state.task_state == linuxcnc.STATE_ON,
            "OFF": lambda: state.task_state != linuxcnc.STATE_ON,
        }

        def reached():
            # LinuxCNC drops a command that its motion controller does not take in time, on a busy computer.
            command.state(getattr(linuxcnc, f"STATE_{name}"))
            command.wait_complete(5.0)
            state.poll()
            return done[name]()

        until(reached, name)

    def home():
        command.mode(linuxcnc.MODE_MANUAL)
        command.wait_complete()
        command.teleop_enable(0)
        command.wait_complete()
        command.home(-1)
        until(lambda: all(state.homed[:3]), "homed")

    def teleop():
        command.mode(linuxcnc.MODE_MANUAL)
        command.wait_complete()
        command.teleop_enable(1)
        command.wait_complete()
        until(lambda: state.motion_mode == linuxcnc.TRAJ_MODE_TELEOP, "teleop")

    def joints():
        command.mode(linuxcnc.MODE_MANUAL)
        command.wait_complete()
        command.teleop_enable(0)
        command.wait_complete()
        until(lambda: state.motion_mode == linuxcnc.TRAJ_MODE_FREE, "joint mode")

    def mdi(line):
        command.mode(linuxcnc.MODE_MDI)
        command.wait_complete()
        command.mdi(line)
        command.wait_complete(30.0)
        until(lambda: state.interp_state == linuxcnc.INTERP_IDLE, line)

    def start(path):
        command.mode(linuxcnc.MODE_AUTO)
        command.wait_complete()
        command.program_open(path)
        command.wait_complete()
        command.auto(linuxcnc.AUTO_RUN, 0)
        until(lambda: state.interp_state != linuxcnc.INTERP_IDLE, "the program runs")

    def running():
        state.poll()
        return state.interp_state != linuxcnc.INTERP_IDLE

    def get(*names):
        return [hal.get_value(name) for name in names]

    def halcmd(*words):
        # Into a file: what halcmd starts keeps the other end of a pipe open.
        with Path("halcmd.txt").open("w+", encoding="utf-8") as out:
            done = subprocess.run(["halcmd", *words], stdout=out, stderr=out, timeout=30, check=False)
            out.seek(0)
            return [done.returncode, out.read()]

    def failures():
        found = []
        while (error := errors.poll()) is not None:
            found.append(error[1])
        return found

    actions = {f.__name__: f for f in (states, home, teleop, joints, mdi, start, running, get, halcmd, failures)}
    path = os.environ["PANEL_SOCKET"]
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(path)
        server.listen(1)
        client, _ = server.accept()
        with client, client.makefile("rw") as lines:
            for line in lines:
                name, *arguments = json.loads(line)
                if name == "quit":
                    break
                try:
                    answer = {"ok": actions[name](*arguments)}
                except (TimeoutError, RuntimeError, linuxcnc.error, subprocess.SubprocessError) as error:
                    answer = {"error": repr(error)}
                lines.write(json.dumps(answer) + "\n")
                lines.flush()
    panel.exit()
