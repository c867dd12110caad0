export default { render({ model, el }) {
  const frame = document.createElement("iframe");
  frame.sandbox = "allow-scripts";
  frame.style.cssText =
    "display:block;box-sizing:border-box;width:100%;height:680px;border:1px solid #8888";
  frame.title = "Maps";
  frame.srcdoc = model.get("html");
  el.append(frame);
} };
