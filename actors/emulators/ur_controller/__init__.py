"""A UR controller without a robot: a process that real client libraries connect to over TCP as to a real controller.

    with VirtualController.start(address="127.0.0.2") as controller:
        control = rtde_control.RTDEControlInterface(controller.address)  # in a process of its own

docs/reference/virtual-devices.md lists its functions and its limitations.
"""

from actors.emulators.ur_controller.controller_process import VirtualController, VirtualControllerError

__all__ = ["VirtualController", "VirtualControllerError"]
