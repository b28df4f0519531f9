"""`python -m actors.emulators.ur_controller.urscript`: translate one program outside the controller's process."""

from actors.emulators.ur_controller.urscript.translator import main

if __name__ == "__main__":
    main()
