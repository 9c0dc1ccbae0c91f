"""What a person looks at: `page.write_report` for one interactive HTML page, `figures.write_figures` for PNG files.

`series` thins long series, `chart` lays them out, `trajectory`, `signals` and `quality` draw one part of a solution
each, `tables` writes the rest. plotly and matplotlib are imported here and nowhere else.
"""
