"""`python -m actors.virtual_ur.urscript`: translate one program apart from the controller's clock."""

from actors.virtual_ur.urscript.translate import main

if __name__ == "__main__":
    main()
