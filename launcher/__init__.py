"""The launcher behind `splannequin.py`: sets up the project's two environments, then runs it.

    places          folders and systems
    interpreters    Pythons of this machine; it and `places` also run under an old Python
    errors          the launcher's exception
    children        child processes
    pip_output      pip's output in an artist's words
    repair          detection of damaged packages
    environments    the virtual environments
    blender         a Blender for the add-on
    summary         DIR/summary.json
    sbom            bill of materials of a set-up's downloads
    doctor, testing, commands, release   the commands
    main            the command line

Each module imports only from modules above it in this list, from the standard library, and from
`torch_backend.contract`, `.shot` and `.cards`.
"""
