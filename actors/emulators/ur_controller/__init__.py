"""A UR controller without a robot: a process that real client libraries talk to over TCP and can't tell apart.

    with VirtualController.start(address="127.0.0.2") as controller:
        control = rtde_control.RTDEControlInterface(controller.address)  # in a process of its own

What it does and what it doesn't is in docs/virtual-ur.md.
"""

from actors.emulators.ur_controller.controller_process import VirtualController, VirtualControllerError

__all__ = ["VirtualController", "VirtualControllerError"]
