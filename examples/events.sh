#!/bin/sh
# Print what happens in the service, a JSON object a line: events.sh [http://127.0.0.1:8650] [topics]
# With a token: export SPIKED_CLIENT_TOKEN=...
curl --silent --no-buffer ${SPIKED_CLIENT_TOKEN:+--oauth2-bearer "$SPIKED_CLIENT_TOKEN"} \
    "${1:-http://127.0.0.1:8650}/api/v1/events?topics=${2:-device,capture,job,scene,log}" | sed -un 's/^data: //p'
