"""The operator's page: an aiohttp server on 127.0.0.1 and what it serves (static/, the charts' script from plotly)."""
