// Print what happens in the service: node events.mjs [ws://127.0.0.1:8650] [topics]
// Node 22 and browsers as it is; Node 20 with --experimental-websocket. In the service's own page the address is
// `ws://${location.host}`, and the browser sends its cookie by itself.
const [address = "ws://127.0.0.1:8650", topics = "device,capture,job,scene,log"] = process.argv.slice(2);
let since = "";

function follow() {
  const events = new WebSocket(`${address}/api/v1/events?topics=${topics}${since}`);
  events.onmessage = ({ data }) => {
    const message = JSON.parse(data);
    since = `&since=${message.seq}`;
    console.log(message.seq, message.topic, JSON.stringify(message.data).slice(0, 100));
  };
  events.onclose = () => setTimeout(follow, 1000);
  events.onerror = () => events.close();
}

follow();
