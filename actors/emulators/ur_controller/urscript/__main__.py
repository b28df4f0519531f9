"""`python -m actors.emulators.ur_controller.urscript`: translate one program apart from the controller's clock."""

from actors.emulators.ur_controller.urscript.translator import main

if __name__ == "__main__":
    main()
