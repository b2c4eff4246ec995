"""The launcher behind `splannequin.py`: makes the two environments the project needs, then runs it.

    places          folders and systems
    interpreters    Pythons of this machine; with `places`, all that runs under an old Python
    errors          the one exception
    children        processes
    pip_output      what pip prints, in an artist's words
    repair          what of an environment is not whole
    environments    the virtual environments
    blender         a Blender for the add-on
    summary         DIR/summary.json
    sbom            what a set-up downloads, as a bill of materials
    doctor, testing, commands, release   the commands
    main            the command line

Each imports only from those above it. Standard library, `torch_backend.contract`, `.shot` and `.cards` only.
"""
