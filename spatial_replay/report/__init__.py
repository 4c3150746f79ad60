"""Reports: one HTML page that shows what a run did, and why.

The flow, file by file:

    write → contents → data, *_panel → page

`write` replays a log and collects the facts, which `contents` defines. `data`, with one module for each
panel, turns them into JSON and packed arrays (`panels`). `page` is the HTML around those, with the scripts
of `browser/`.
"""
