"""Reports: one HTML page that shows what a run did, and why.

The flow, file by file:

    write → data → panels → page

`write` replays a log and collects the facts, as a `RunReport`. `data` converts the facts to JSON and packed
arrays, with the parts of each panel in `panels`. `page` is the HTML around these data, with the scripts of
`browser/`.
"""
