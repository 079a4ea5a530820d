// A recording in JavaScript: npm install, then  node recording.mjs FILE.mcap
// Read as a stream, so that the file of the day, which is still being written, is read as well.
import { McapStreamReader } from "@mcap/core";
import { decompress } from "fzstd";
import { createReadStream } from "node:fs";

// Finished recordings are compressed with zstd; the file of the day is not.
const decompressHandlers = { zstd: (bytes, size) => decompress(bytes, new Uint8Array(Number(size))) };
const reader = new McapStreamReader({ decompressHandlers });
const text = new TextDecoder();
const topics = new Map();
const states = {};
let measured = 0, largest = 0, largestLeft = 0, estimate = null;

function take(record) {
  if (record.type === "Channel") topics.set(record.id, record.topic);
  if (record.type !== "Message") return;
  const topic = topics.get(record.channelId);
  if (topic !== "/estimate" && topic !== "/offset") return;
  const message = JSON.parse(text.decode(record.data));
  if (topic === "/offset") {
    states[message.state] = (states[message.state] ?? 0) + 1;
    // The offset is added to the commanded Y: what is left of the deformation is their sum. null is missing, never 0.
    if (estimate?.seq === message.seq && estimate.y_um !== null && message.y_offset_um !== null) {
      measured += 1;
      largest = Math.max(largest, Math.abs(estimate.y_um));
      largestLeft = Math.max(largestLeft, Math.abs(estimate.y_um + message.y_offset_um));
    }
  } else {
    estimate = { seq: message.seq, y_um: message.y_um };
  }
}

for await (const piece of createReadStream(process.argv[2])) {
  reader.append(piece);
  for (let record; (record = reader.nextRecord()) != undefined; ) take(record);
}
console.log("states:", JSON.stringify(states));
console.log(`${measured} samples with Y measured: at most ${largest.toFixed(2)} µm, with the offset ${largestLeft.toFixed(2)} µm`);
