"""A viewer in the browser: worlds side by side, live from the simulation, with what steers and explains them.

============  =============================================================
``settings``  where a page is served, and how many worlds it shows
``player``    steps worlds under a policy, and remembers what curves show
``page``      the page: scene, buttons, sliders, curves
``viewer``    both together: in real time, in a loop or beside a notebook
============  =============================================================
"""
