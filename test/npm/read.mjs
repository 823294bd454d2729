// Read an mcap file as Foxglove does, and print what it has as one line of JSON: each message by topic, stamp and what
// its type is known by.
import { parse } from "@foxglove/rosmsg";
import { MessageReader } from "@foxglove/rosmsg2-serialization";
import { McapIndexedReader } from "@mcap/core";
import { FileHandleReadable } from "@mcap/nodejs";
import { loadDecompressHandlers } from "@mcap/support";
import { open } from "node:fs/promises";

const handle = await open(process.argv[2]);
const reader = await McapIndexedReader.Initialize({
  readable: new FileHandleReadable(handle),
  decompressHandlers: await loadDecompressHandlers(),
});
const decoders = new Map();
for (const [id, schema] of reader.schemasById) {
  const definition = parse(new TextDecoder().decode(schema.data), { ros2: true });
  decoders.set(id, new MessageReader(definition));
}
const messages = [];
for await (const message of reader.readMessages({ validateCrcs: true })) {
  const channel = reader.channelsById.get(message.channelId);
  const decoded = decoders.get(channel.schemaId).readMessage(message.data);
  messages.push({
    topic: channel.topic,
    encoding: channel.messageEncoding,
    stamp: String(message.logTime),
    header: decoded.header,
    width: decoded.width,
    points: decoded.points?.length,
    data: decoded.data === undefined ? undefined : Buffer.from(decoded.data).toString("base64"),
  });
}
await handle.close();
console.log(JSON.stringify({ profile: reader.header.profile, messages }));
