"""From what a robot's sensors log to views, places and traces.

- `readers`: read logs of CARMEN, ROS bags and scans in text files.
- `places`: correct the track by matching scans, find places and visits in local maps, and write
  the trace (`importing.import_log`).
- `views`: cluster images into views by k-means, and choose the number of views.
- `recognition`: recognise the dstate of a single image by nearest neighbour.
- `images`: the images of a trace in one table.

Import from the modules. The package itself exports nothing, so that no command loads what it does
not need.
"""
