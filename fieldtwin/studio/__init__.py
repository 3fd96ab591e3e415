"""Studio: see and operate a prototype or a plant in the browser.

The web server is a separate process. It queries gateway, PLC and field simulator through their control channels, as the
command line does, and reads the capture of the buses from its file. Therefore it delays neither a poll nor a scan.

`live` observes instances and keeps their history, `scenarios` records and runs scenarios; neither knows HTTP. `api` is the REST
and WebSocket interface. `static` holds the pages, which use only that interface.
"""
