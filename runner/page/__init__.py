"""The operator's page: an aiohttp server on 127.0.0.1 and the files it serves (static/, plotly's script)."""
